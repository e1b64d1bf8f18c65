"""Draw the figures of pages: run each page's examples and save what they call `figure`.

python docs/pictures/pages.py [docs/filters/huber.md ...]; without a page, README and all filters.
"""

import re
import sys
from pathlib import Path

import matplotlib.pyplot as plt

HERE = Path(__file__).resolve().parent
EXAMPLE = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)


def draw(page: Path) -> None:
    """Run the examples of one page in one namespace and save its figure beside this script."""
    text = page.read_text("utf-8")
    if f"pictures/{page.stem}.png" not in text:
        return
    namespace = {"__name__": "__main__"}
    for code in EXAMPLE.findall(text):
        exec(compile(code, str(page), "exec"), namespace)
    target = HERE / f"{page.stem}.png"
    namespace["figure"].savefig(target, dpi=110)
    plt.close("all")
    print(f"wrote {target.relative_to(HERE.parents[1])}")


if __name__ == "__main__":
    plt.switch_backend("agg")
    pages = [HERE.parents[1] / "README.md", *sorted((HERE.parent / "filters").glob("*.md"))]
    for page in [Path(p) for p in sys.argv[1:]] or pages:
        draw(page)
