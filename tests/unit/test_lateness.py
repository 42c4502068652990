"""Which commands are too old, in networks whose true delays are known."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator

from msgspec import Struct

from acsard.core.motion.ages import MAX_CLOCKS, Ages, Order
from acsard.core.values import NS_PER_S, Command, Echo, Ns, Twist
from tests.each import each

TIMEOUT_NS = NS_PER_S // 4

SPEED = Twist(0.5, 0.0)

START_S, RUN = 1000.0, 7

PROMPT_S = 0.1  # a command this young is prompt, beyond the least delay of its network

Delay = Callable[[float], float]  # s after the start -> s


class Network(Struct):
    """The delays of both directions, and a step and the resolution of the sender's clock."""

    up: Delay
    down: Delay
    loss: float = 0.0
    step_at: float = 0.0
    step: float = 0.0
    grain: float = 0.0
    seconds: float = 60.0

    def journeys(self, dice: random.Random) -> Iterator[tuple[int, float, float, float]]:
        """Yield number, sending, arrival and newest beat of each command, in true time, s."""
        beats = list(self._beats())
        last, newest = 0.0, 0
        for number in range(int(self.seconds * 20.0)):
            at = number / 20.0 + dice.uniform(-0.002, 0.002)
            while newest + 1 < len(beats) and beats[newest + 1][1] <= at:
                newest += 1
            if dice.random() < self.loss or beats[newest][1] > at:
                continue  # a program without a beat waits
            last = max(at + self.up(at), last)
            yield number + 1, at, last, beats[newest][0]

    def _beats(self) -> Iterator[tuple[float, float]]:
        last, at = 0.0, -2.0
        while at < self.seconds:
            last = max(last, at + self.down(max(at, 0.0)))
            yield at, last
            at += 0.05

    def stamp(self, at: float) -> float:
        at += self.step if self.step and at >= self.step_at else 0.0
        return at // self.grain * self.grain if self.grain else at


def _ns(seconds: float) -> Ns:
    return round((START_S + seconds) * NS_PER_S)


class Outcome(Struct):
    """Figures of a network: oldest obeyed command, s; prompt commands and refused ones."""

    oldest: float = 0.0
    prompt: int = 0
    refused: int = 0
    verdicts: tuple[str, ...] = ()


def play(network: Network, echoes: bool, dice: random.Random) -> Outcome:
    """Play a network, and judge each command by its echo or by its stamp."""
    ages, order, outcome, verdicts = Ages(), Order(), Outcome(), set()
    journeys = list(network.journeys(dice))
    least = min(arrived - sent for _, sent, arrived, _ in journeys)
    for number, sent, arrived, beat in journeys:
        command = Command(
            "app",
            SPEED,
            _ns(arrived),
            None if echoes else _ns(network.stamp(sent)),
            "clock",
            "sender",
            sequence=number,
            echo=Echo(RUN, _ns(beat)) if echoes else None,
            age_ns=_ns(arrived) - _ns(beat) if echoes else None,
        )
        verdict = ages.judge_age(command, order, TIMEOUT_NS, stalled=False)
        verdicts.add(verdict)
        age = arrived - sent
        if not verdict:
            outcome.oldest = max(outcome.oldest, age)
        if age < least + PROMPT_S:
            outcome.prompt += 1
            outcome.refused += bool(verdict)
    outcome.verdicts = tuple(sorted(verdicts))
    return outcome


def jitter(dice: random.Random, base: float, peaks: float = 0.0) -> Delay:
    """Return a delay with an exponential tail and, in a share of `peaks`, 0.1 s more."""

    def delay(_: float) -> float:
        return base + dice.expovariate(1 / 0.004) + (0.1 if dice.random() < peaks else 0.0)

    return delay


# Round trip and share of peaks, with the largest share of prompt commands that may be refused.
ROUND_TRIPS = {"LAN": (0.002, 0.0, 0.005), "100 ms": (0.1, 0.02, 0.02), "200 ms": (0.2, 0.0, 0.05)}


MS = 1_000_000
BOUND_S = TIMEOUT_NS / NS_PER_S + 0.1


@each("name", list(ROUND_TRIPS))
@each("echoes", [True, False])
def test_few_prompt_commands_are_refused(name: str, echoes: bool) -> None:
    way, peaks, most = ROUND_TRIPS[name]
    dice = random.Random(name)
    up, down = jitter(dice, way / 2, peaks), jitter(dice, way / 2, peaks)
    outcome = play(Network(up, down, seconds=120.0), echoes, dice)
    assert outcome.prompt > 2200
    assert outcome.refused / outcome.prompt <= most


def lifted(height: float, begin: float, rise: float, end: float) -> Delay:
    """Return a delay that rises from `begin` on and has ended at `end`."""
    return lambda t: height * max(0.0, min(1.0, (t - begin) / rise, (end - t) / rise))


ROWS: dict[str, tuple[Delay, float, float]] = {  # delay, lost share, most prompt ones refused
    "clean": (lambda t: 0.0, 0.0, 0.02),
    "outage of 3 s, then a burst": (lambda t: 13 - t if 10 < t < 13 else 0.0, 0.0, 0.02),
    "outage of 20 s, then a burst": (lambda t: 30 - t if 10 < t < 30 else 0.0, 0.0, 0.02),
    "congestion to 1 s for 3 s": (lifted(1.0, 10.0, 1.0, 15.0), 0.0, 0.03),
    "congestion to 1 s for 20 s": (lifted(1.0, 10.0, 1.0, 32.0), 0.0, 0.03),
    "congestion to 5 s for 20 s": (lifted(5.0, 10.0, 5.0, 45.0), 0.0, 0.03),
    "jump by 0.6 s for 20 s": (lambda t: 0.6 if 10 < t < 30 else 0.0, 0.0, 0.03),
    "growth by 0.1 s/s to 5 s": (lambda t: max(0.0, min(5.0, 0.1 * (t - 5))), 0.0, 0.1),
    "growth by 0.02 s/s to 1 s": (lambda t: max(0.0, min(1.0, 0.02 * (t - 5))), 0.0, 0.1),
    "30 % lost": (lambda t: 0.0, 0.3, 0.02),
    "30 s of backlog at the first contact": (lambda t: max(0.0, 30 - t / 2), 0.0, 1.0),
}


@each("name", list(ROWS))
@each("echoes", [True, False])
def test_no_old_command_is_obeyed_and_few_prompt_ones_are_refused(name: str, echoes: bool) -> None:
    dice, (delay, loss, most) = random.Random(0), ROWS[name]
    wifi = jitter(dice, 0.004, 0.02)
    outcome = play(Network(lambda t: wifi(t) + delay(t), wifi, loss), echoes, dice)
    assert outcome.oldest <= BOUND_S
    assert outcome.refused / max(1, outcome.prompt) <= most


@each("step", [10.0, -10.0, -0.4])
def test_after_a_clock_step_no_old_command_counts_and_the_cause_is_named(
    step: float,
) -> None:
    dice = random.Random(1)
    wifi = jitter(dice, 0.004, 0.02)
    outcome = play(Network(wifi, wifi, step_at=10.0, step=step), False, dice)
    assert outcome.oldest <= BOUND_S
    assert ("set_back" in outcome.verdicts) == (step < 0)
    assert outcome.refused / outcome.prompt <= (1.0 if step < 0 else 0.02)


# stamps


class Sender:
    """One sender whose commands arrive at given times, in ms, with stamps."""

    def __init__(self, until_ms: int = -1) -> None:
        self.ages, self.order, self.number = Ages(), Order(), 0
        for at_ms in range(0, until_ms + 1, 50):
            verdict = self.hear(at_ms, at_ms)
        assert until_ms < 0 or verdict == ""

    def hear(self, at_ms: float, stamp_ms: float | None, clock: str = "a") -> str:
        self.number += 1
        at_ns = int(at_ms * MS) + 1000 * NS_PER_S
        stamp_ns = None if stamp_ms is None else int(stamp_ms * MS) + 1000 * NS_PER_S
        command = Command("app", SPEED, at_ns, stamp_ns, clock, "a", sequence=self.number)
        return self.ages.judge_age(command, self.order, TIMEOUT_NS, stalled=False)


def test_a_new_clock_counts_when_its_least_delay_has_not_fallen_for_one_timeout() -> None:
    sender = Sender()
    verdicts = [sender.hear(50 * n, 50 * n - (3 - n if n < 3 else 0) * 20) for n in range(9)]
    assert verdicts == ["unproven"] * 8 + [""]  # the delay falls until the fourth


def test_a_lower_delay_counts_when_the_commands_of_one_timeout_confirm_it() -> None:
    sender = Sender(1000)
    assert sender.hear(1050, 9000) == "early"  # one from the future changes nothing
    assert [sender.hear(at, at) for at in range(1100, 3000, 50)] == [""] * 38
    verdicts = [sender.hear(3050 + 50 * n, 3101 + 50 * n) for n in range(6)]
    assert verdicts == ["early"] * 5 + [""]
    assert sender.hear(3400, 3300) == "not_newer"
    assert sender.hear(3750, 3500) == "stale"


@each("queue_ms", [400, 600, 800, 1000])
@each("seconds", [5, 8, 12])
def test_a_queue_is_refused_although_the_lower_delays_before_it_were_never_proven(
    queue_ms: int, seconds: int
) -> None:
    """Behind a pause, the sender's clock runs 8 % fast, as chrony slews it, and then right."""
    sender, begun_ms = Sender(1000), 1000 + 1000 * seconds
    verdicts = {sender.hear(at, at + 0.08 * (at - 1000)) for at in range(2000, begun_ms, 50)}
    assert verdicts == {"early"}
    ahead_ms = 80 * seconds
    late = {sender.hear(at, at - queue_ms + ahead_ms) for at in range(begun_ms, 60_000, 50)}
    assert "" not in late


@each("every_ms", [10, 50, 200])
@each("ahead_ms", [0, 40, 280, 3000])
def test_a_prompt_program_counts_beside_the_backlog_of_another_one_with_its_identity(
    every_ms: int, ahead_ms: int
) -> None:
    sender, verdicts = Sender(1000), {}
    for at_ms in range(9000, 12_000, 10):
        if at_ms % every_ms == 0:  # sent from 1.05 s on
            assert sender.hear(at_ms, 1050 + (at_ms - 9000) / every_ms * 5) != ""
        if at_ms % 50 == 5 or at_ms % 50 == 0:
            verdicts[at_ms] = sender.hear(at_ms + 5, at_ms + 5 + ahead_ms)
    assert {verdict for at_ms, verdict in verdicts.items() if at_ms > 9600} == {""}


def test_the_least_delay_rises_by_at_most_one_timeout_in_any_hour() -> None:
    sender, hour_ms = Sender(1000), 3_600_000
    obeyed: list[tuple[int, float]] = []
    for second in range(2, 3 * 3600):
        late_ms = second * 0.1  # 0.1 ms/s is 360 ms in an hour, and no queue grows so evenly
        if sender.hear(second * 1000, second * 1000 - late_ms) == "":
            obeyed.append((second * 1000, late_ms))
    last_ms, late_ms = obeyed[-1]
    assert last_ms > hour_ms  # a clock that drifts is followed
    assert late_ms <= 250 * (1 + last_ms / hour_ms) + 1


@each(("back_ms", "at_s"), [(200, 0), (300, 100), (400, 300), (500, 500), (510, None)])
def test_a_clock_that_was_slewed_back_and_a_queue_of_as_much_count_at_the_same_time(
    back_ms: int, at_s: int | None
) -> None:
    """Both have these arrivals and stamps, so what heals the one obeys the other."""
    sender, late_ms, refused_s = Sender(1000), 0.0, 0.0
    for at_ms in range(1050, 1_200_000, 50):
        late_ms = min(back_ms, late_ms + 4.15)  # 83 ms per second, as chrony slews
        if sender.hear(at_ms, at_ms - late_ms):
            refused_s = at_ms / 1000
    if at_s is None:
        assert refused_s > 1199.9
    else:
        assert abs(refused_s - at_s) <= 4.0


@each(
    ("silence_s", "late_ms", "verdict"),
    [
        (100, 299, ""), (100, 301, "stale"),  # the rise of 0.5 ms/s, and the timeout
        (3500, 501, "stale"),  # at most a timeout
        (3599, 5000, "stale"), (3601, 5000, "unproven"),  # forgotten after an hour
    ],
)  # fmt: skip
def test_a_silence(silence_s: int, late_ms: int, verdict: str) -> None:
    at_ms = 1000 + silence_s * 1000
    assert Sender(1000).hear(at_ms, at_ms - late_ms) == verdict


def test_a_flood_of_new_clocks_does_not_push_out_a_clock_that_counts() -> None:
    sender = Sender(1000)
    for number in range(3 * MAX_CLOCKS):
        assert sender.hear(1001 + number, 5, f"stranger {number}") == "unproven"
    assert len(sender.ages.clocks) == MAX_CLOCKS
    assert sender.hear(1060, 1060) == ""


def test_no_number_of_short_publishers_makes_a_known_queue_new() -> None:
    sender, at_ms = Sender(1000), 1000
    for number in range(500):
        for _ in range(12):  # each is prompt, and drives after one timeout
            at_ms += 50
            assert sender.hear(at_ms - 1, at_ms - 3001) in ("stale", "set_back")
            verdict = sender.hear(at_ms, at_ms, f"publisher {number}")
        assert verdict == ""
    assert len(sender.ages.clocks) == MAX_CLOCKS


def test_a_new_publisher_in_each_minute_drives_and_makes_no_known_clock_new() -> None:
    sender, hour_s = Sender(1000), 3600
    for begin_s in range(60, hour_s, 60):
        name = f"publisher {begin_s}"
        verdicts = [sender.hear(begin_s * 1000 + n, begin_s * 1000 + n, name) for n in (0, 250)]
        assert verdicts == ["unproven", ""]
    at_ms = (hour_s - 1) * 1000  # the known one comes back behind a queue of 3 s
    assert {sender.hear(at_ms + n, at_ms + n - 3000) for n in range(0, 1500, 50)} == {"stale"}


def test_a_table_full_of_refused_clocks_refuses_a_new_one_until_it_forgets_them() -> None:
    sender = Sender()
    names = [f"clock {number}" for number in range(MAX_CLOCKS)]
    for at_ms in range(0, 1001, 50):
        verdicts = [sender.hear(at_ms, at_ms, name) for name in names]
    assert verdicts == [""] * MAX_CLOCKS
    assert {sender.hear(5000, 2000, name) for name in names} == {"stale"}
    assert sender.hear(5050, 5050, "new") == "too_many_clocks"
    assert sender.hear(3_605_050, 3_605_050, "new") == "unproven"  # an hour later


def test_a_table_of_clocks_that_are_prompt_again_takes_a_new_one() -> None:
    sender, names = Sender(), [f"clock {number}" for number in range(MAX_CLOCKS)]
    for at_ms in range(0, 1001, 50):
        verdicts = [sender.hear(at_ms, at_ms, name) for name in names]
    assert verdicts == [""] * MAX_CLOCKS
    assert {sender.hear(5000, 2000, name) for name in names} == {"stale"}
    assert sender.hear(5050, 5050, names[0]) == ""
    assert sender.hear(5100, 5100, "new") == "unproven"


def test_a_queue_that_arises_during_a_proof_is_remembered() -> None:
    sender = Sender()
    assert [sender.hear(50 * n, 50 * n) for n in range(4)] == ["unproven"] * 4
    assert sender.hear(1000, 200) == "stale"
    for number in range(2 * MAX_CLOCKS):
        assert sender.hear(1001 + number, 1001 + number, f"stranger {number}") == "unproven"
    verdicts = {sender.hear(at_ms, at_ms - 800) for at_ms in range(1200, 8000, 50)}
    assert "" not in verdicts


def test_stamps_that_stand_still_are_refused_and_named_after_two_seconds() -> None:
    sender = Sender(1000)
    verdicts = [sender.hear(1050 + 50 * n, 1050) for n in range(50)]
    assert verdicts[:7] == ["", *["not_newer"] * 5, "stale"]
    assert set(verdicts[7:41]) == {"stale"}
    assert set(verdicts[41:]) == {"stamps"}
    assert sender.hear(3800, 3800) == ""
    sender = Sender()  # a new clock that stands still is never proven
    assert "" not in {sender.hear(50 * n, 0) for n in range(50)}
    sender = Sender(1000)  # a network may repeat each command twice
    for at_ms in range(1050, 4000, 50):
        assert sender.hear(at_ms, at_ms) == ""
        assert [sender.hear(at_ms + late_ms, at_ms) for late_ms in (1, 40)] == ["not_newer"] * 2


@each("grain_s", [0.1, 0.5, 1.0, 10.0])
def test_a_clock_that_advances_in_steps_lets_no_old_command_count(grain_s: float) -> None:
    dice = random.Random(3)
    wifi, queue = jitter(dice, 0.004, 0.02), lifted(3.0, 10.0, 1.0, 30.0)
    network = Network(lambda t: wifi(t) + queue(t), wifi, grain=grain_s)
    assert play(network, False, dice).oldest <= BOUND_S


def test_without_a_stamp_only_the_order_of_the_numbers_counts() -> None:
    sender = Sender()
    assert [sender.hear(at_ms, None) for at_ms in (0, 50)] == ["", ""]
    sender.number = 0
    assert sender.hear(10_049, None) == "not_newer"
    sender.number = 0
    assert sender.hear(10_050, None) == ""  # the program may have started again


# echoes


def echo(age_ms: float | None, number: int = 1, beat_ms: int = 100) -> Command:
    age_ns, beat = None if age_ms is None else int(age_ms * MS), Echo(RUN, beat_ms * MS)
    at_ns = 1000 * NS_PER_S
    return Command("app", SPEED, at_ns, 5, "a", "a", sequence=number, echo=beat, age_ns=age_ns)


@each(
    ("age_ms", "verdict"),
    [(0, ""), (300, ""), (301, "too_old"), (-1, "from_future"), (None, "other_run")],
)
def test_the_age_of_an_echo_is_judged_without_its_stamp(age_ms: float | None, verdict: str) -> None:
    assert Ages().judge_age(echo(age_ms), Order(), TIMEOUT_NS, stalled=True) == verdict


@each(
    ("number", "beat_ms", "verdict"),
    [
        (5, 100, "not_newer"), (4, 100, "not_newer"), (9, 50, "not_newer"), (6, 100, ""),
        (0, 150, ""),
    ],
)  # fmt: skip
def test_echoes_are_ordered_by_the_beat_and_then_by_the_number_and_must_go_on(
    number: int, beat_ms: int, verdict: str
) -> None:
    ages, order = Ages(), Order()
    assert ages.judge_age(echo(0, 5), order, TIMEOUT_NS, stalled=False) == ""
    assert ages.judge_age(echo(0, number, beat_ms), order, TIMEOUT_NS, stalled=False) == verdict
    plain = Command("app", SPEED, 1001 * NS_PER_S, 7, "a", "a", sequence=9)
    assert ages.judge_age(plain, order, TIMEOUT_NS, stalled=False) == "no_echo"


@each("ahead", [0, 3, 10_000])  # 0: a program that was forked
def test_two_programs_with_one_sender_id_are_noticed(ahead: int) -> None:
    ages, order, verdicts = Ages(), Order(), []
    for beat in range(1, 250):  # 12 s
        at_ns = 1000 * NS_PER_S + beat * 50 * MS
        for late_ms in (0, 20) if beat < 100 else (0,):
            fresh = Echo(RUN, at_ns + late_ms * MS)
            number = beat + ahead * (late_ms > 0)
            command = Command(
                "app", SPEED, fresh.beat_ns, 5, "a", "a", sequence=number, echo=fresh, age_ns=0
            )
            verdicts.append(ages.judge_age(command, order, TIMEOUT_NS, stalled=False))
    assert verdicts[:3] == ["", "", ""]
    assert verdicts[4:198].count("copied") >= 95
    assert verdicts[-1] == ""  # the other one has ended


@each("sequences", [[*range(200, 230), *range(40), *range(30)], [7] * 50])
def test_a_program_that_counts_anew_or_not_at_all_is_no_copy(sequences: list[int]) -> None:
    ages, order = Ages(), Order()
    for beat, number in enumerate(sequences):
        assert ages.judge_age(echo(0, number, 100 + beat), order, TIMEOUT_NS, stalled=False) == ""
