"""Robots that come with the package, in the own format; `load(name).source` says where each number comes from.

| name | what it is |
|---|---|
| `paper37` | 37 degrees of freedom: free base, four 7-joint arms, three reaction wheels (composed) |
| `deos7` | 7-joint arm on a 696 kg servicer, after DEOS |
| `iiwa_free` | LBR iiwa 14 on a free 1000 kg bus |
| `ets7` | ETS-VII: 6-joint arm on a 2550 kg satellite |
| `planar3` | planar 3-joint air-bearing test-bed |
| `planar100` | planar 3-joint arm on a 100 kg chaser, of a published detumbling study |
| `envisat`, `sat50` | targets: ENVISAT, and a 50 kg satellite |
"""

from pathlib import Path

from sdyn import files
from sdyn.checks import known
from sdyn.robot import Robot

FOLDER = Path(__file__).parent


def names() -> tuple[str, ...]:
    """The names of the shipped models."""
    return tuple(sorted(path.stem for path in FOLDER.glob("*.json")))


def load(name: str) -> Robot:
    """A shipped model.

    Raises:
        RobotError: If there is none of that name; the message lists the close ones.
    """
    known(name, names(), "model")
    return files.load(FOLDER / f"{name}.json")
