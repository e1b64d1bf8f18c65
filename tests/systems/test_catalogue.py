"""The catalogue against the systems it tells of."""

from pathlib import Path

import pytest

from robins import scenario, systems
from robins.systems import SYSTEMS, catalogue

FOLDERS = {f.parent.name: f for f in Path(systems.__file__).parent.glob("*/scenarios")}


def test_every_system_is_in_the_catalogue():
    assert {name.replace("-", "_") for name in catalogue.SUMMARIES} == set(FOLDERS)
    assert list(SYSTEMS) == list(catalogue.SUMMARIES)
    assert "boat" not in SYSTEMS
    with pytest.raises(KeyError, match="boat"):
        SYSTEMS["boat"]
    assert catalogue.listed("boat") == {}


@pytest.mark.parametrize("name", catalogue.SUMMARIES)
def test_every_packaged_file_is_a_scenario_or_configures_a_replay(name):
    system, listed = SYSTEMS[name], catalogue.listed(name)
    assert system.name == name
    for path in FOLDERS[name.replace("-", "_")].glob("*.toml"):
        of_pairs = system.alignment and system.alignment.parameters
        parameters = system.replay_parameters or of_pairs
        if path.stem in listed:
            of = listed[path.stem]
            assert of.path == system.scenarios[path.stem] == path
            assert of.title
            parameters = system.studies[of.study or next(iter(system.studies))].parameters
        assert parameters is not None
        assert scenario.load(parameters, path)


def test_scenarios_of_a_study_stand_together():
    studies = [listed.study for listed in catalogue.listed("rocket").values()]
    assert studies == sorted(studies, reverse=True)
    assert list(catalogue.listed("ins-gnss")) == ["drive"]


def test_claims_that_studies_share_are_told_once():
    claims = [(claim["id"], claim["text"]) for claim in SYSTEMS["rocket"].claims]
    assert len(set(claims)) == len(claims) == 11
