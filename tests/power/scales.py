"""Two scales of the tests' power, their results in a file, and what a later tree has lost.

A result is the test that noticed the item, `NOBODY`, `UNREACHED`, `UNDECIDED`, or None if it
was never tried.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections import Counter
from collections.abc import Collection
from pathlib import Path

from tests.power.equivalent import EQUIVALENT
from tests.power.history import hunks
from tests.power.mutants import mutants
from tests.power.trials import NOBODY, UNDECIDED, UNREACHED, Trial

SAMPLE = 1000
Results = dict[str, dict[str, str | None]]


def drawn(root: Path, only: Collection[str], seed: int) -> list[Trial]:
    """Return all mutants in a random order that depends on the seed.

    The order follows from each mutant's key. So an edit of the source moves only its own mutants.
    With `only`, the modules are those whose path contains one of these.
    """
    met: Counter[str] = Counter()
    lots: list[tuple[bytes, Trial]] = []
    paths = sorted(path.relative_to(root).as_posix() for path in root.glob("acsard/**/*.py"))
    for path in (path for path in paths if not only or any(part in path for part in only)):
        for _, _, statement, key, text in mutants(root, path):
            met[key] += 1
            lot = hashlib.sha256(f"{seed} {met[key]} {key}".encode()).digest()
            name = f"{key} #{met[key]}" if met[key] > 1 else key
            lines = frozenset({statement} - {0})
            lots.append((lot, Trial("mutants", name, path, lines, text)))
    return [trial for _, trial in sorted(lots, key=lambda pair: pair[0])]


def sample(pool: list[Trial], known: Collection[str]) -> list[Trial]:
    """Return the mutants with these names, or the first ones if there are none.

    A mutant whose function is in another module now keeps its name.
    """
    if not known:
        return [trial for trial in pool if trial.name not in EQUIVALENT][:SAMPLE]
    gone = set(known) - {trial.name for trial in pool}
    moved = {name.partition(" ")[2]: name for name in gone}
    here = [trial for trial in pool if trial.name in known]
    return here + [
        trial._replace(name=moved.pop(tail))
        for trial in pool
        if (tail := trial.name.partition(" ")[2]) in moved
    ]


def present(
    root: Path, scales: Collection[str], known: Results, only: Collection[str]
) -> list[Trial]:
    """Return the items of this tree in the order in which to try them: the scales take turns."""
    found: list[list[Trial]] = []
    if "mutants" in scales:
        found.append(sample(drawn(root, only, seed=1), known.get("mutants", ())))
    if "hunks" in scales:
        found.append(list(hunks(root)))
    turns = [(at / len(items), item) for items in found for at, item in enumerate(items)]
    return [item for _, item in sorted(turns, key=lambda turn: turn[0])]


def load(file: Path) -> tuple[str, Results]:
    """Return the commit and the results of a file, or nothing if there is none."""
    if not file.exists():
        return "", {}
    content = json.loads(file.read_text(encoding="utf-8"))
    return content.pop("commit"), content


def save(file: Path, commit: str, results: Results) -> None:
    """Write one line for each item, so that a change of it is readable."""
    file.parent.mkdir(parents=True, exist_ok=True)
    text = json.dumps({"commit": commit} | results, indent=0, sort_keys=True, ensure_ascii=False)
    part = file.with_suffix(".part")
    part.write_text(text + "\n", encoding="utf-8")
    os.replace(part, file)


def report(known: Results, now: Results, items: list[Trial]) -> bool:
    """Print what was noticed once and is not now. Return whether there is anything.

    Args:
        known: The results of the older tree.
        now: Those of this tree, as far as they were measured.
        items: The items that this tree still has.
    """
    here = {(item.scale, item.name) for item in items}
    any_lost = False
    for scale, results in sorted(known.items()):
        noticed = {name: test for name, test in results.items() if was_noticed(test)}
        gone = [name for name in noticed if (scale, name) not in here]
        tried = {name: now.get(scale, {}).get(name) for name in noticed if name not in gone}
        lost = [name for name, test in tried.items() if is_measured(test) and not was_noticed(test)]
        for name in lost:
            print(f"LOST {scale}: {name}\n    {tried[name]}; before: {noticed[name]}")
        modules = Counter(re.findall(r"acsard/\S+\.py|$", name)[0] or name for name in gone)
        for module, count in sorted(modules.items()):
            print(f"gone {scale}: {count} with code of {module}")
        untried = sum(not is_measured(test) for test in tried.values())
        never = sum(not is_measured(test) for test in results.values())
        print(
            f"{scale}: of {len(noticed)} that were noticed {len(tried) - untried - len(lost)} "
            f"still are, {len(lost)} are lost, {len(gone)} are gone with their code, and "
            f"{untried} were not tried; {never} of {len(results)} were never measured before"
        )
        any_lost = any_lost or bool(lost)
    return any_lost


def was_noticed(test: str | None) -> bool:
    return is_measured(test) and test not in (NOBODY, UNREACHED)


def is_measured(test: str | None) -> bool:
    return test not in (None, UNDECIDED)
