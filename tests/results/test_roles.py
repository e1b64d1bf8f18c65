"""Roles: what holds of every row of the table, in folders, in figures and in documents."""

import re
from pathlib import Path

import numpy as np
import pytest
import role_table
import xarray as xr
from example_folder import a_summary, write

from robins import report
from robins.results import ROLES, array, find, read, roles

DOCS = Path(__file__).resolve().parents[2] / "docs"
# Tables show these, or nothing does.
NOT_DRAWN = {"attitude", "bound_left", "covariance", "gramian", "trade_off_bound", "context"}


def examples():
    """Examples of what an array may be of: every choice, or a name that begins like another."""
    for role in ROLES:
        found = re.search(r"\{(.*)\}", role.variable)
        for of in found[1].split("|") if found else [""]:
            yield role, "gyro_bias" if of and "|" not in role.variable else of


@pytest.mark.parametrize(("role", "of"), list(examples()), ids=lambda x: getattr(x, "variable", x))
def test_an_array_is_found_by_its_role_and_an_old_one_by_its_name(role, of):
    values = np.ones([2] * len(roles.dims(role, of)))
    needed = dict.fromkeys(role.attrs, 1)
    made = array(role.name, values, of, unit="m", frame="NED", **needed)
    (name,) = made
    assert name == re.sub(r"\{.*\}", of, role.variable)
    assert roles.fault(name, made[name]) == ""
    assert made[name].attrs["long_name"]
    solution = xr.Dataset(made)
    assert list(find(solution, role.name)) == [of]
    assert find(solution, role.name)[of].identical(solution[name])
    del solution[name].attrs["role"]
    solution[name].attrs.pop("of", None)
    assert find(solution, role.name) == {}
    assert list(find(roles.recognised(solution), role.name)) == [of]


def test_all_rows_have_names_of_their_own():
    names = [role.array_name(of) for role, of in examples()]
    assert len(names) == len(set(names))


@pytest.mark.parametrize(
    ("role", "of", "changes", "message"),
    [
        ("speed", "x", {}, "there is no role 'speed'; use one of track, reference, gnss, "),
        ("track", "x_m", {}, "no array of role 'track' is of 'x_m': its names are {lat_rad|"),
        ("sigma", "", {}, "no array of role 'sigma' is of '': its names are sigma_{block}"),
        ("outage", "gnss", {}, "no array of role 'outage' is of 'gnss'"),
        ("sigma", "x", {"unit": ""}, "sigma_x: has no unit"),
        ("rms", "x", {"runs": 9}, ""),
        ("rms", "x", {}, "rms_x: the attribute 'runs' is missing"),
        ("sigma", "x", {"dims": "a b"}, "sigma_x: has dimensions a, b, not filter time axis_{of}"),
        ("context", "x", {"dims": "a b"}, ""),
    ],
)
def test_an_array_that_is_not_what_its_role_says_is_refused(role, of, changes, message):
    settings = {"unit": "m", "dims": "a b c"} | changes
    values = np.zeros([1] * len(settings["dims"].split()))
    if message:
        with pytest.raises(ValueError, match=re.escape(message)):
            array(role, values, of, **settings)
    else:
        assert list(array(role, values, of, **settings)) == [f"{role}_x".removeprefix("context_")]


def test_a_folder_of_before_there_were_roles_is_read_and_drawn(tmp_path, monkeypatch):
    """The names are those of that time, by hand; the longest one that fits counts."""
    old = {
        "error_position": ("error", "position"),
        "sigma_position": ("sigma", "position"),
        "mean_sigma_position": ("mean_sigma", "position"),
        "innovation_sigma_gnss": ("innovation_sigma", "gnss"),
        "nis_dof_gnss": ("nis_dof", "gnss"),
        "bound_left_gyro_bias": ("bound_left", "gyro_bias"),
        "allan_low_gyro": ("allan_low", "gyro"),
        "reference_lat_rad": ("reference", "lat_rad"),
        "gnss_quality": ("gnss_quality", ""),
        "anees": ("consistency", "anees"),
        "anees_dof": ("consistency_dof", "anees"),
        "gramian_rank": ("gramian_rank", ""),
        "rest": ("context", "rest"),
    }
    told = {"units": "1", "long_name": "as it was"}
    rows = {name: (("filter", "time"), np.ones((1, 3)), told) for name in old}
    with monkeypatch.context() as before:
        before.setattr(roles, "fault", lambda name, array: "")
        write(tmp_path / "old", a_summary(), xr.Dataset(rows, {"filter": ["a"]}))
    back = read(tmp_path / "old").solution
    got = {n: (back[n].attrs["role"], back[n].attrs.get("of", "")) for n in back.data_vars}
    assert got == old
    names = [p.name for p in report.pictures(back, a_summary(filters={"a": {}}))]
    assert names == ["error_position", "anees"]


def test_every_role_has_a_figure_and_a_line_in_the_documents():
    drawn = {role for figure in report.FIGURES for role in figure.roles.split()}
    assert drawn | NOT_DRAWN | {"outage"} == {role.name for role in ROLES}
    assert not drawn & NOT_DRAWN
    _, _, *lines = role_table.rows()
    for role, line in zip(ROLES, lines, strict=True):
        assert line.startswith(f"| `{role.name}` | `")
        assert line.count("|") == 7
        assert ("{py:func}" in line) == (role.name in drawn)
        assert all(f"`{attr}`" in line for attr in role.attrs)
    assert "```{include} _generated/arrays.txt" in (DOCS / "contract.md").read_text("utf-8")
