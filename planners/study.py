"""Many runs of one sort, one after the other, that survive being killed: what is finished is kept, bit for bit.

    results = planners.study("out/masses", {"light": {"mass": 50}, "heavy": {"mass": 500}}, work)

A folder holds a file of arrays for each run, and a journal with one line for each that is finished: its name, seed and
the hash of its file. A run counts once its line is whole; then its file is on the disk already.
"""

import fcntl
import hashlib
import io
import json
import os
from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path

import numpy as np

JOURNAL, LOCK = "journal.jsonl", ".lock"


class StudyError(ValueError):
    """A folder that holds another study, or that another process writes to."""


def study(
    folder, runs: dict[str, dict], work: Callable[..., dict], *, seed: int = 0, chained: bool = False
) -> dict[str, dict[str, np.ndarray]]:
    """Do all runs that are not done yet.

    Args:
        folder: For the results; made if it is not there.
        runs: {name: parameters}, the parameters as JSON can hold them.
        work: Of the parameters and a random generator, to {name: array}. The generator depends on the seed and the
            run's name alone, so a result does not know which runs were done before it, or in which process.
        seed: Of the study.
        chained: Whether work takes a third argument, the results of the runs before this one in their order.

    Returns:
        {name: arrays} of all runs, in their order; the same bits whether or not the study was interrupted.

    Raises:
        StudyError: If the folder holds a study of other runs or another seed, or is in use.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    head = {"format": "sdyn-study", "version": 1, "seed": seed, "runs": _sum(json.dumps(runs).encode())}
    with _locked(folder):
        done, out = _journal(folder, head), {}
        for name, parameters in runs.items():
            path = folder / f"{_sum(name.encode())[:16]}.npz"
            if name not in done or not path.is_file() or _sum(path.read_bytes()) != done[name]:
                rng = np.random.default_rng([seed, int(_sum(name.encode())[:16], 16)])
                data = _packed(work(parameters, rng, *([out] if chained else [])))
                _put(path, data)
                _append(folder, {"run": name, "file": path.name, "sha256": _sum(data)})
            out[name] = _arrays(path)
        return out


@contextmanager
def _locked(folder):
    """Hold the folder for this process; the lock goes with it, however it ends."""
    with (folder / LOCK).open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise StudyError(f"another process writes to {folder}; wait for it, or use another folder.") from None
        yield


def _journal(folder, head) -> dict[str, str]:
    """{run: hash of its file} of what is finished; a line that was cut off is taken away."""
    path = folder / JOURNAL
    text = path.read_bytes() if path.exists() else b""
    whole = text[: text.rfind(b"\n") + 1]
    if whole != text:
        with path.open("r+b") as file:
            file.truncate(len(whole))
            os.fsync(file.fileno())
    try:
        first, *lines = [json.loads(line) for line in whole.splitlines()] or [None]
        done = {line["run"]: line["sha256"] for line in lines}
    except (ValueError, KeyError, TypeError):
        raise StudyError(f"{path} is no journal of a study; use another folder.") from None
    if first is None:
        _append(folder, head)
    elif first != head:
        raise StudyError(f"{folder} holds a study of other runs or another seed; use another folder.")
    return done


def _append(folder, line):
    handle = os.open(folder / JOURNAL, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o666)
    try:
        os.write(handle, json.dumps(line).encode() + b"\n")
        os.fsync(handle)
    finally:
        os.close(handle)


def _put(path, data):
    """Write a file whole or not at all; the name beside it is the same each time, so nothing piles up."""
    beside = path.with_suffix(".part")
    with beside.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    os.replace(beside, path)


def _packed(arrays) -> bytes:
    file = io.BytesIO()
    np.savez(file, allow_pickle=False, **arrays)
    return file.getvalue()


def _arrays(path) -> dict[str, np.ndarray]:
    with np.load(path, allow_pickle=False) as file:
        return dict(file)


def _sum(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
