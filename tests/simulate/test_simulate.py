"""The simulator itself: it repeats a seed to the byte, finds a planted fault and shrinks it."""

from __future__ import annotations

import json
import random
import re
import shutil
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from acsard.core.values import Latches
from tests.scenarios.world import START
from tests.simulate import __main__ as main
from tests.simulate import pairs, shrink
from tests.simulate.actors import Result, played
from tests.simulate.followed import Followed
from tests.simulate.jerk import Slope
from tests.simulate.pairs import OURS, Pair, Trace
from tests.simulate.plan import KINDS, Plan, made
from tests.simulate.product import Disk, problems
from tests.simulate.promises import BrokenError, Witness
from tests.simulate.roads import NS, Message, messages, sample

PLAIN = next(p for p in map(made, range(99)) if "odd configuration" not in p["kinds"])
EMPTY: Plan = {
    "seed": 0, "seconds": 2.0, "kinds": [], "board": [], "senders": [], "events": [],
    "lawful": "a new client",
}  # fmt: skip


def quiet() -> Plan:
    """A plan in which nothing happens but the lawful drive at the end."""
    return EMPTY | {"config": PLAIN["config"]}


def test_a_seed_gives_the_same_bytes_again_also_when_its_plan_was_written_to_a_file() -> None:
    first, again = Trace(), Trace()
    one = made(4, 15.0)
    text = json.dumps(one)
    assert text == json.dumps(made(4, 15.0))
    results = [played(one, first.step), played(json.loads(text), again.step)]
    assert first.hashes == again.hashes
    assert len(first.hashes) > 15
    assert results[0].finding == results[1].finding == ""


def test_every_configuration_of_a_plan_is_legal_and_every_kind_of_trouble_is_drawn() -> None:
    plans = [made(seed) for seed in range(30)]
    assert [problems(one["config"]) for one in plans] == [[]] * 30
    assert {kind for one in plans for kind in one["kinds"]} == set(KINDS)


def test_a_sender_sends_the_same_without_the_other_senders() -> None:
    one = next(p for p in map(made, range(20)) if len(p["senders"]) > 2)
    alone = shrink.without(one, [("senders", 0)])
    both = [
        messages(plan_["senders"][place], plan_["seed"], one["seconds"], 0)
        for plan_, place in ((one, 1), (alone, 0))
    ]
    assert both[0] == both[1] != []


def test_a_quiet_plan_breaks_no_promise() -> None:
    assert played(quiet()).finding == ""


def test_a_seed_of_a_replay_is_played_and_reported(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(main, "made", lambda seed: made(seed, 3.0))
    assert main.replay("17") == 0
    assert " s simulated in " in capsys.readouterr().out
    broken = Result(17, "a promise at 2.000 s: so", "a promise", 2 * NS, 2.0, 0.1, Counter())
    monkeypatch.setattr(main, "played", lambda plan: broken)
    assert main.replay("17") == 1
    assert " seed 17: a promise at 2.000 s: so\n" in capsys.readouterr().out


def test_seeds_are_played_until_the_time_is_simulated_and_what_they_covered_is_printed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(main, "made", lambda seed: made(seed, 3.0))
    assert main.explore(1, 0.012, 2) == 0
    out = capsys.readouterr().out
    assert re.search(r": \d runs from seed 1, 0\.0\d h simulated in .* 0 findings\n", out)
    assert re.search(r"^  way +\w+ \d", out, re.MULTILINE)


# the witness


def moves(witness: Witness, at_s: float) -> None:
    """Put a first slow line on the wire."""
    witness.line(
        int(at_s * NS), b"ap00.02,bp00.02,cp00.02,dp00.02\r\n", int(at_s * NS), int(at_s * NS)
    )


def witnessed() -> Witness:
    """A witness of a robot that has just started, and drives."""
    witness = Witness(PLAIN["config"])
    witness.step(NS // 2, "driving", "driving: commanded by app")
    return witness


@pytest.mark.parametrize(
    ("what", "promise"),
    [
        (lambda w: None, "motion needs a fresh wish of an armed sender"),
        (lambda w: w.stops.append(NS // 2), "nothing moves after a stop"),
        (lambda w: w.offs.append(NS // 2), "nothing moves after being switched off"),
        (lambda w: w.step(NS, "fault", "it is broken somehow"), "no fault without a cause"),
        (lambda w: setattr(w, "linked", False), "only a linked board is driven"),
        (lambda w: w.step(NS, "ready", ""), "every state has a reason"),
        (
            lambda w: w.line(NS, b"ap99.00,bp99.00,cp99.00,dp99.00\r\n", NS, NS),
            "no wheel is over its limit",
        ),
        (
            lambda w: w.line(NS, b"ap05.00,bp05.00,cp05.00,dp05.00\r\n", NS, NS),
            "no acceleration is over its limit",
        ),
        (
            lambda w: w.line(NS, b"ap00.02,bp00.02,cp00.02,dp00.02\r\n", 0, NS),
            "a silent board gets zeros",
        ),
        (lambda w: w.line(NS, b"ap00.02,bp00.02\r\n", NS, NS), "every line is whole"),
        (
            lambda w: w.line(2 * NS, b"ap00.02,bp00.02,cp00.02,dp00.02\r\n", 2 * NS, NS),
            "no line leaves later than it was made",
        ),
    ],
)
def test_the_witness_sees_what_must_not_be(what: Callable[[Witness], None], promise: str) -> None:
    witness = witnessed()

    def run() -> None:
        what(witness)
        moves(witness, 1.0)

    with pytest.raises(BrokenError) as broken:
        run()
    assert broken.value.promise == promise


def ramp(witness: Witness, fastest: float, share: float) -> None:
    """Put lines on the wire that fall from this speed by a share of the deceleration."""
    radius, fall = witness.radius, witness.limits["linear_deceleration"]
    for n in range(1, 400):
        speed = fastest - n * 0.01 * share * fall / radius
        if speed <= 0.0:
            return
        words = [letter + b"p%05.2f" % speed for letter in (b"a", b"b", b"c", b"d")]
        at_ns = NS + n * NS // 100
        witness.line(at_ns, b",".join(words) + b"\r\n", at_ns, at_ns)


@pytest.mark.parametrize(
    ("stopped", "promise"),
    [
        (False, "without a wish the robot comes to rest"),
        (True, "nothing moves after being switched off"),
    ],
)
def test_a_ramp_that_takes_twice_as_long_as_from_its_own_speed_is_a_finding(
    stopped: bool, promise: str
) -> None:
    for share in (1.0, 0.5):
        witness = witnessed()
        fastest = 0.6 * witness.limits["linear_deceleration"] / witness.radius
        witness.limits["wheel_speed"] = witness.softest["wheel_speed"] = 2 * fastest
        witness.limits["linear_speed"] = witness.softest["linear_speed"] = 99.0
        witness.last, witness.last_ns = (fastest,) * 4, NS
        if stopped:
            witness.offs.append(NS)
        if share == 1.0:
            ramp(witness, fastest, share)
        else:
            with pytest.raises(BrokenError, match=promise):
                ramp(witness, fastest, share)


def test_a_clear_that_its_sender_sent_before_the_stop_must_not_release_it() -> None:
    witness = witnessed()
    witness.stops.append(5 * NS)
    with pytest.raises(BrokenError, match="releases no later stop"):
        witness.cleared(9 * NS, 4 * NS, "cleared; each sender must send a zero", "ann")
    witness.cleared(9 * NS, 6 * NS, "cleared; each sender must send a zero", "ann")
    assert witness.held is None


@pytest.mark.parametrize(("junk", "armed"), [("not a number", False), ("stranger", True)])
def test_a_zero_before_what_may_be_a_speed_of_the_same_identity_arms_nobody(
    junk: str, armed: bool
) -> None:
    witness = witnessed()
    sender = made(1)["senders"][0] | {"way": "plain", "source": "app", "churn": False}
    for at_s, v, kind in ((1.0, 0.0, ""), (1.5, 0.0, junk), (2.5, 0.3, "")):
        one = Message(int(at_s * NS), int(at_s * NS), v, 0.0, 0, 0, kind)
        witness.command(sender, one, sample(sender, one, PLAIN["config"], 0), one.arrives_ns)
    assert (witness.wishes[-1][1].armed_ns == NS) is armed


def test_a_set_that_had_no_answer_may_be_in_force_after_a_restart_or_not() -> None:
    witness = witnessed()
    limit = witness.file["wheel_speed"]
    witness.unanswered("set", {"limits.wheel_speed": 0.5 * limit}, 4 * NS)
    witness.new_life(5 * NS)
    assert (witness.limits["wheel_speed"], witness.unsure) == (limit, {"wheel_speed"})
    witness.set_limits(6 * NS, {"limits.wheel_speed": 0.7 * limit}, 6 * NS)
    assert (witness.limits["wheel_speed"], witness.unsure) == (0.7 * limit, set())


def test_a_daemon_that_has_ended_writes_nothing_when_the_disk_has_room_again() -> None:
    disk = Disk()
    disk.fill(True)
    disk.keep(Latches(lowered={"limits.wheel_speed": 1.0}))
    assert disk.behind
    disk.end()
    disk.fill(False)
    assert disk.read(START).lowered == {}
    assert not disk.behind


def test_a_stop_that_had_no_answer_may_be_gone_after_a_restart() -> None:
    witness = witnessed()
    witness.stops += [2 * NS, 4 * NS]
    witness.unanswered("stop", {}, 4 * NS)
    assert witness.stops == [2 * NS]


def with_a_set_before_sigterm(settings: dict[str, float]) -> Plan:
    """A plan whose `set` has no answer when SIGTERM ends the daemon: the disk is full."""
    call = {"verb": "set", "settings": settings, "late": 0.0, "lost": False, "twice": False}
    events: list[dict[str, Any]] = [
        {"at": 1.0, "do": "disk", "for": 0.6},
        {"at": 1.5, "do": "call", "by": "ann", "via": "native", **call},
        {"at": 1.505, "do": "restart", "way": "term", "for": 0.2},
    ]
    return quiet() | {"seconds": 3.0, "events": events}


def test_a_limit_that_was_lowered_on_the_way_down_is_no_finding() -> None:
    lowered = {"limits.wheel_speed": 0.1 * PLAIN["config"]["limits"]["wheel_speed"]}
    assert played(with_a_set_before_sigterm(lowered)).finding == ""


def followed_in_turn(*sent: tuple[float, str, float, float]) -> None:
    """Have the robot follow each command of two `signed` senders: time, sender, speed, by."""
    witness = witnessed()
    followed = Followed(witness)
    base = made(1)["senders"][0] | {
        "way": "signed", "source": "app", "wheels": False, "delay": 0.0, "churn": False,
        "jitter": 0.0, "congestion": [],
    }  # fmt: skip
    for number, (at_s, name, v, by_s) in enumerate(sent):
        sender = base | {"id": name, "clock": [["step", 5.0, by_s]] if by_s else []}
        at_ns = int(at_s * NS)
        one = Message(at_ns, at_ns, v, 0.0, at_ns, number, "")
        found = sample(sender, one, PLAIN["config"], 0)
        wish = witness.command(sender, one, found, at_ns)
        followed.command(sender, one, found, at_ns, wish)
        followed.step(at_ns + 1, at_ns + 1, at_ns, "driving", "up")


def test_a_second_sender_that_is_followed_before_the_first_is_silent_is_a_finding() -> None:
    followed_in_turn((4.0, "a", 0.3, 0.0), (6.0, "b", 0.3, 0.0))
    with pytest.raises(BrokenError, match="the first of equal priority keeps the robot"):
        followed_in_turn((4.0, "a", 0.3, 0.0), (4.05, "b", 0.3, 0.0))


def test_a_clock_that_was_set_and_drives_without_a_zero_is_a_finding() -> None:
    followed_in_turn((4.0, "a", 0.3, -2.0), (7.0, "a", 0.0, -2.0), (7.1, "a", 0.3, -2.0))
    with pytest.raises(BrokenError, match="a clock that jumped needs a zero"):
        followed_in_turn((4.0, "a", 0.3, -2.0), (7.1, "a", 0.3, -2.0))


def test_a_slope_that_grows_faster_than_the_jerk_is_seen_through_the_rounding() -> None:
    for jerk, allowed in ((2.0, True), (6.0, False)):
        slope, found = Slope(), True
        for n in range(30):
            speed = round(jerk * (n * 0.01) ** 2 / 2 / 0.0005) * 0.0005
            found = slope.take(speed, 0.01, 2.0, 4.0, 0.00026) and found
        assert found is allowed


# shrinking


def test_shrinking_leaves_what_the_finding_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(one: Plan) -> Result:
        verbs = [event.get("verb") for event in one["events"]]
        found = "clear" in verbs and any(s["phases"] for s in one["senders"])
        name = "a made-up promise" if found else ""
        return Result(1, name, name, int(500 * NS), 1.0, 0.1, Counter())

    monkeypatch.setattr(shrink, "played", broken)
    dice = random.Random(1)
    large = next(
        p for p in map(made, range(99)) if any(e.get("verb") == "clear" for e in p["events"])
    )
    dice.shuffle(large["events"])
    small = shrink.shrunk(large, broken(large))
    assert [event.get("verb") for event in small["events"]] == ["clear"]
    assert [len(sender["phases"]) for sender in small["senders"]] == [1]
    assert not problems(small["config"])


# pairs


def copy_of_the_package(where: Path) -> Path:
    """Make another checkout of the package alone, as an installed wheel is one.

    Its compiled modules come along, because compiling all of them takes longer than the plan.
    """
    shutil.copytree(OURS / "acsard", where / "acsard")
    return where


def test_a_paired_run_finds_no_difference_to_the_same_code_and_names_the_first_one_else(
    tmp_path: Path,
) -> None:
    other = copy_of_the_package(tmp_path)
    one = quiet()
    pair = Pair(OURS, other)
    assert pair.sides[1].package.is_relative_to(tmp_path)
    assert pair.differs(one)[0] == ""
    pair.close()
    words = other / "acsard" / "core" / "motion" / "arbiter_text.py"
    text = words.read_text(encoding="utf-8")
    words.write_text(text.replace("waiting for a command", "no command"), encoding="utf-8")
    pair = Pair(OURS, other)
    difference, _ = pair.differs(one)
    pair.close()
    assert "reason: here 'waiting for a command" in difference
    assert "there 'no command" in difference


def test_an_event_that_is_left_out_of_pairs_is_in_no_plan_of_theirs() -> None:
    one = next(p for p in map(made, range(99)) if any(e["do"] == "restart" for e in p["events"]))
    less = pairs.comparable(one, (("do", "restart", "it restarts in another way"),))
    assert {event["do"] for event in one["events"]} - {event["do"] for event in less["events"]} == {
        "restart"
    }


def test_a_listed_difference_is_taken_out_on_both_sides() -> None:
    listed = (("reason", "no command|waiting for a command", "X", "new words"),)
    steps = [
        pairs.rewritten({"at": 1, "reason": words}, listed)
        for words in ("waiting for a command: now", "no command: now")
    ]
    assert steps[0] == steps[1] == {"at": 1, "reason": "X: now"}
