"""What an installation weighs: our wheel, and the runtime dependencies beyond the five that do the work.

    python benchmarks/install_size.py [--wheel FILE.whl]

Dependencies are those that pyproject.toml names, as installed here, without extras, with theirs; sizes are of the installed files, byte-compiled ones left out.
The five (numpy, OpenCV, scikit-learn, pymavlink, mavsdk) and what they need themselves are listed apart.
"""

from __future__ import annotations

import argparse
import tomllib
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

THE_FIVE = ("numpy", "opencv-python-headless", "scikit-learn", "pymavlink", "mavsdk")
MB = 1_000_000


def direct_dependencies() -> list[str]:
    """Return what our package names itself: an editable installation may be older than that."""
    with (Path(__file__).parents[1] / "pyproject.toml").open("rb") as file:
        return [Requirement(text).name for text in tomllib.load(file)["project"]["dependencies"]]


def needed_by(*names: str) -> set[str]:
    """Return packages and everything that they need, by canonical name."""
    found: set[str] = set()
    waiting = list(names)
    while waiting:
        current = str(canonicalize_name(waiting.pop()))
        if current in found:
            continue
        try:
            requirements = distribution(current).requires or []
        except PackageNotFoundError:  # for another platform or Python
            continue
        found.add(current)
        for text in requirements:
            requirement = Requirement(text)
            if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
                waiting.append(requirement.name)
    return found


def size_bytes(name: str) -> int:
    total = 0
    for file in distribution(name).files or ():
        path = Path(str(file.locate()))
        if path.suffix != ".pyc" and path.is_file():
            total += path.stat().st_size
    return total


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--wheel", type=Path, help="our wheel, to say its size")
    wheel = parser.parse_args().wheel
    if wheel is not None:
        print(f"wheel {wheel.stat().st_size / MB:.2f} MB")
    of_the_five = needed_by(*THE_FIVE)
    others = needed_by(*direct_dependencies()) - of_the_five
    for title, names in (("beyond the five", others), ("the five, and what they need", of_the_five)):
        sizes = sorted(((size_bytes(name), name) for name in names), reverse=True)
        print(f"{title}: {sum(size for size, _ in sizes) / MB:.1f} MB")
        for size, name in sizes:
            print(f"  {size / MB:7.2f} MB  {name}")


if __name__ == "__main__":
    main()
