"""`python -m tests.tools.figures`: measure acsard here, and write the page of figures.

    python -m tests.tools.figures                       # all sections
    python -m tests.tools.figures daemon page           # these only
    python -m tests.tools.figures packages --dist dist  # the files of deploy/release/build
    python -m tests.tools.figures daemon --print        # write nothing

A section says when and where it was measured. `service` needs root and a systemd in a container.
"""

from __future__ import annotations

import argparse
import os
import platform
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory

from acsard import client
from acsard.host.version import version
from tests.bench.matching import staircase
from tests.bench.rig import ACSARD, processor_ns
from tests.bench.rigs import POLLED, config, delays_us, rig, share, waits_us
from tests.bench.test_side_by_side import shares_of_a_pair
from tests.pages import ROOT
from tests.system.browser import Page
from tests.system.harness import Daemon, cpu_seconds, resident_kb, until
from tests.systemd.image import build, needs
from tests.tools.fleet_figures import fleet
from tests.tools.link_figures import link
from tests.tools.reference import table

PAGE = ROOT / "deploy/manual/pages/explanation/figures.md"

DAY_S = 86400


class MissingError(Exception):
    """This machine cannot measure a section. The message says what it lacks."""


Rows = Iterable[tuple[str, ...]]


def daemon(_: Path) -> str:
    """Measure the daemon with the benchmarks' simulated board, and one subscriber of `odom`."""
    settings = config()
    began = time.monotonic()
    with rig(settings) as running:
        start_s = time.monotonic() - began
        used, at = processor_ns(running.process.pid), time.monotonic()
        time.sleep(15.0)
        rest = (processor_ns(running.process.pid) - used) / (time.monotonic() - at) / 1e9
        driven = running.command(15.0, staircase)
        memory = resident_kb(running.process.pid) / 1000
        threads = len(list(Path(f"/proc/{running.process.pid}/task").iterdir()))
        counters = running.bus.state()["counters"]
        record = running.end()
    waits, delays = waits_us(record), delays_us(settings, record)
    with rig(config(), POLLED) as polled:
        polled.command(6.0, staircase)
        simple = polled.end()
    pairs = [shares_of_a_pair(ACSARD, seed) for seed in range(5)]
    ratio = median(ours / theirs for ours, theirs in pairs)
    lines, sent = counters["lines"], counters["lines_sent"]
    lost = {name: counters.get(name, 0) for name in ("missed_periods", "lines_superseded")}
    rejected = sum(n for name, n in counters.items() if name.startswith("line_"))

    def times(values: list[float]) -> str:
        return " / ".join(f"{share(values, part) / 1000:.2f}" for part in (0.5, 0.9, 0.99))

    return table(
        ("quantity", "acsard"),
        [
            ("processor at rest, % of a core", f"{100 * rest:.1f}"),
            ("processor with 25 commands a second, each of another speed, % of a core",
             f"{100 * driven:.1f}"),
            ("the same, times that of a bare polled loop (`tests/bench/polled.py`) beside it",
             f"{ratio:.2f}"),
            ("command to line, median / 90 % / 99 %, ms", times(waits)),
            ("the same of the polled loop", times(waits_us(simple))),
            ("line to `odom` at another process, median / 90 % / 99 %, ms", times(delays)),
            ("the same of the polled loop", times(delays_us(settings, simple))),
            ("lines of the board taken / rejected", f"{lines} / {rejected}"),
            ("lines sent / superseded / periods missed",
             f"{sent} / {lost['lines_superseded']} / {lost['missed_periods']}"),
            ("memory (resident), MB; threads", f"{memory:.0f}; {threads}"),
            ("from the start of the process to its tenth `odom`, s", f"{start_s:.1f}"),
        ],
    )  # fmt: skip


def page(where: Path) -> str:
    """Measure the robot's page, with nobody looking."""
    with Daemon(where) as robot, Page(robot, where) as server:
        time.sleep(3.0)
        used, at = cpu_seconds(server.pid), time.monotonic()
        time.sleep(15.0)
        share_ = (cpu_seconds(server.pid) - used) / (time.monotonic() - at)
        memory = resident_kb(server.pid) / 1000
    return table(
        ("quantity", "page"),
        [
            ("processor without a viewer, % of a core", f"{100 * share_:.1f}"),
            ("memory (resident), MB", f"{memory:.0f}"),
        ],
    )


def disk(where: Path) -> str:
    """Measure what the black box of a simulated robot writes."""
    records, seconds = where / "record", 40.0

    def written() -> int:
        return sum(file.stat().st_size for file in records.rglob("*") if file.is_file())

    tables = {"record": {"directory": str(records)}}
    with Daemon(where, config=tables) as robot, client.connect(robot.endpoint) as driver:
        time.sleep(3.0)
        before = written()
        time.sleep(seconds)
        rest = (written() - before) / seconds
        before, began = written(), time.monotonic()
        while time.monotonic() - began < seconds:
            driver.drive(0.3, 0.5, seconds=4.0)
            driver.drive(-0.2, 0.1, seconds=4.0)
        driven = (written() - before) / (time.monotonic() - began)
    return table(
        ("the black box of a simulated robot", "MB a day", "hours in the default 1,000 MB"),
        [
            (what, f"{rate * DAY_S / 1e6:.0f}", f"{1000e6 / rate / 3600:.0f}")
            for what, rate in (("at rest", rest), ("driving all the time", driven))
        ],
    )


def packages(dist: Path) -> str:
    """Return the sizes of a release's files."""
    files = sorted(dist.glob("acsard*")) if dist.is_dir() else []
    if not any(file.suffix == ".deb" for file in files):
        raise MissingError("name the files of deploy/release/build with --dist")
    rows = []
    for file in files:
        installed = "-"
        if file.suffix == ".deb":
            said = _run("dpkg-deb", "--field", str(file), "Installed-Size")
            installed = f"{int(said) * 1024 / 1e6:.1f}"
        rows.append((f"`{file.name}`", f"{file.stat().st_size / 1e6:.2f}", installed))
    return table(("file", "MB", "installed, MB"), rows)


def service(where: Path) -> str:
    """Time the change of the version in a booted systemd, with the usual watch of 30 s."""
    if missing := needs():
        raise MissingError(missing)
    from tests.systemd.test_upgrade import BAD, NEW, installing, started

    rootfs = os.environ.get("ACSARD_TEST_ROOTFS")
    root = build(Path(rootfs) if rootfs else where / "rootfs")
    took: dict[str, float] = {}

    def timed(what: str, act: Callable[[], object]) -> None:
        began = time.monotonic()
        act()
        took[what] = time.monotonic() - began

    with ExitStack() as stack:
        container = stack.enter_context(installing(root, where))
        with started(container) as robot:
            robot.makes(NEW)
            timed("upgrade, with the watch of 30 s", lambda: robot.changes(NEW, 30.0))
            assert robot.runs() == NEW
            timed("rollback, with the watch of 30 s", lambda: robot.changes(robot.old, 30.0))
            assert robot.runs() == robot.old
            robot.makes(NEW, BAD["crashes later"])
            timed("a version that dies after 5 s, until the old one runs",
                  lambda: robot.changes(NEW, 30.0))  # fmt: skip
            assert robot.runs() == robot.old
            began = time.monotonic()
            container.run("systemctl", "kill", "--signal=KILL", "acsard.service")
            until(robot.link, 30.0, "the link is up again")
            took["`kill -9`, until the link to the board is up again"] = time.monotonic() - began
    return table(("change", "s"), ((what, f"{taken:.0f}") for what, taken in took.items()))


def tests(_: Path) -> str:
    """Count what stands behind a release."""
    words = [sys.executable, "-m", "pytest", "--collect-only", "-q", "-n", "0", "-m", ""]
    listed = _run(*words).splitlines()
    cases = sum("::" in line for line in listed)
    plans = len(list(Path(ROOT, "tests/simulate/corpus").iterdir()))
    planted = Path(ROOT, "tests/simulate/PLANTED.md").read_text().count("\n| ") - 1
    drives = len(list(Path(ROOT, "tests/recordings").glob("*.rec.zst")))
    nightly = Path(ROOT, ".github/workflows/nightly.yml").read_text()
    (hours,) = re.findall(r"-m tests\.simulate .*--hours (\d+)", nightly)
    return table(
        ("what", "number"),
        [
            ("tests, of all marks", f"{cases:,}"),
            ("random plans that once found a fault, played before each change", str(plans)),
            ("planted faults that the random plans must find", str(planted)),
            ("recorded drives that must replay to the bit", str(drives)),
            ("robot-hours of new random plans each night", hours),
        ],
    )


def _run(*words: str) -> str:
    return subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True).stdout


SECTIONS: dict[str, Callable[[Path], str]] = {
    "daemon": daemon,
    "page": page,
    "disk": disk,
    "fleet": fleet,
    "link": link,
    "packages": packages,
    "service": service,
    "tests": tests,
}


def here() -> str:
    """Return the date, the version and this computer, as a sentence."""
    cpu = re.search(r"^(?:model name|Model)\s*: (.+)$", Path("/proc/cpuinfo").read_text(), re.M)
    cores = len(os.sched_getaffinity(0))
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    virtual = "virtual machine, " if _is_virtual() else ""
    return (
        f"Measured {time.strftime('%Y-%m-%d')} with acsard {version().removesuffix('.dirty')} on: "
        f"{virtual}{cpu[1].strip() if cpu else platform.machine()}, {cores} cores, "
        f"{memory:.0f} GB, Linux {platform.release().split('-')[0]}, "
        f"Python {platform.python_version()}, load {os.getloadavg()[0]:.0f} when it began."
    )


def _is_virtual() -> bool:
    return " hypervisor" in Path("/proc/cpuinfo").read_text()


def with_section(text: str, name: str, body: str) -> str:
    """Return the page with another body of a section."""
    mark = rf"(^<!-- figures {name}: .* -->\n)(?:.*\n)*?(^<!-- end -->$)"
    changed, count = re.subn(
        mark, lambda found: f"{found[1]}\n{body}\n{found[2]}", text, flags=re.M
    )
    assert count == 1, f"the page has no section {name}"
    return changed


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("section", nargs="*", metavar="SECTION", help=", ".join(SECTIONS))
    parser.add_argument("--dist", type=Path, default=ROOT / "dist", help="for the section packages")
    parser.add_argument("--print", action="store_true", help="write nothing into the page")
    options = parser.parse_args()
    if unknown := set(options.section) - set(SECTIONS):
        parser.error(f"no section {', '.join(unknown)}: choose from {', '.join(SECTIONS)}")
    code = 0
    for name in options.section or SECTIONS:
        where = here()
        with TemporaryDirectory(prefix="acsard-figures-") as place:
            try:
                body = SECTIONS[name](options.dist if name == "packages" else Path(place))
            except MissingError as missing:
                print(f"{name} is not measured: {missing}", file=sys.stderr)
                code = 1
                continue
        print(f"{name}\n{where}\n{body}", flush=True)
        if not options.print:
            text = with_section(PAGE.read_text(encoding="utf-8"), name, f"{where}\n\n{body}")
            PAGE.write_text(text, encoding="utf-8")
    return code


if __name__ == "__main__":
    sys.exit(main())
