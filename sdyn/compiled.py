"""Compiled programs that are kept between processes, and never used unless they are as they were written.

JAX does not notice a flipped bit in an entry: it was seen to compute other numbers, and to crash. So the folder holds a
list of the hashes of its entries; what is not in it, or differs, is removed and compiled again.
"""

import atexit
import hashlib
import json
from pathlib import Path

from sdyn.files import write

SUMS = "sums.json"


def keep_in(folder: Path) -> list[str]:
    """Use a folder for compiled programs, from now to the end of the process.

    Args:
        folder: Made if it is not there.

    Returns:
        Names of the entries that were changed since they were written, and are gone.
    """
    import jax

    folder.mkdir(parents=True, exist_ok=True)
    known, changed = _sums(folder), []
    for path in folder.glob("*-cache"):
        if path.name not in known:  # of a process that was killed, or is still running
            path.unlink(missing_ok=True)
        elif _sum(path) != known[path.name]:
            changed.append(path.name)
            path.unlink(missing_ok=True)
    write(folder / SUMS, json.dumps({name: x for name, x in known.items() if name not in changed}).encode())
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
    atexit.register(_record, folder)
    return changed


def _record(folder):
    """Add the entries that are new to the list; one that another process removed is left out."""
    known = _sums(folder)
    names = {path.name for path in folder.glob("*-cache")}
    known = {name: known.get(name) or _sum(folder / name) for name in sorted(names)}
    write(folder / SUMS, json.dumps(known).encode())


def _sums(folder) -> dict:
    try:
        known = json.loads((folder / SUMS).read_text())
        return known if isinstance(known, dict) else {}
    except (OSError, ValueError):
        return {}


def _sum(path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
