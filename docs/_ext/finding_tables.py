"""Tables of the doctor's findings and of what `clean` refuses, out of `robins.logs.doctor`."""

from generated import setup_of, table

from robins.logs.doctor import ALONE, OF_READERS, REFUSALS, TOGETHER


def findings() -> str:
    """A heading and a table for each topic, in the order of the examination."""
    topics = {"In the files": list(OF_READERS)}
    for check in (*ALONE, *TOGETHER):
        topics.setdefault(check.topic, []).extend(check.codes)
    head = ("code", "severity", "says")
    return "\n".join(f"### {topic}\n\n{table(head, codes)}" for topic, codes in topics.items())


def refusals() -> str:
    """Why rows are refused."""
    return table(("reason", "what"), REFUSALS.items())


setup = setup_of(findings=findings, refusals=refusals)
