"""The faults of the fake MCU are on inside their block and off after it."""

from __future__ import annotations

import inspect

from acsard.core.config.named_faults import ARGUMENTS, FAULTS, named
from acsard.core.config.settings import Config, SimConfig
from acsard.core.simulator.fake_mcu import FakeMcu
from acsard.core.simulator.faults import Faults
from tests.each import each


def switches(faults: Faults) -> dict[str, object]:
    return {k: v for k, v in vars(faults).items() if not k.startswith("_")}


def test_every_fault_without_required_arguments_is_in_the_list_of_faults() -> None:
    methods = vars(Faults) | vars(FakeMcu)
    free = {
        name
        for name, method in methods.items()
        if callable(method) and not name.startswith("_")
        if inspect.signature(method).return_annotation in ("Fault", "Iterator[None]")
        if all(
            p.default is not p.empty
            for p in list(inspect.signature(method).parameters.values())[1:]
        )
    }
    assert sorted(FAULTS) == sorted(free)


BOARDS = ("free_running", "estop", "bumpers")
"""Faults that need the events of the board, so `fake_mcu.py` has them."""


@each("name", [name for name in FAULTS if name not in BOARDS])
def test_a_fault_changes_its_switch_and_restores_it(name: str) -> None:
    faults = Faults()
    before = switches(faults)
    with getattr(faults, name)():
        assert switches(faults) != before
    assert switches(faults) == before


def test_a_fault_of_every_fifth_reply_hits_each_fifth_reply() -> None:
    faults = Faults()
    with faults.lost_replies(every=5):
        hits = [faults._hit("reply", faults.lose_reply) for _ in range(10)]
    assert hits == [False, False, False, False, True] * 2
    assert not any(faults._hit("reply", faults.lose_reply) for _ in range(10))


def test_a_bit_error_flips_one_bit_and_a_different_one_each_time() -> None:
    faults, data = Faults(), bytes(40)
    with faults.bit_errors(every=1):
        turned = [int.from_bytes(faults._damaged(data), "big") for _ in range(320)]
    assert all(number.bit_count() == 1 for number in turned)
    assert len(set(turned)) == 320
    assert faults._damaged(data) == data


def test_bit_errors_leave_empty_data_unchanged() -> None:
    faults = Faults()
    with faults.bit_errors(every=1):
        assert faults._damaged(b"") == b""


EXAMPLE = {"m": "b", "mm": "b:c", "mn": "b:2", "n": "9600", "nn": "5:0.1", "nnn": "1:5:2"}
EACH = (*FAULTS, *(f"{name}={EXAMPLE[kinds]}" for name, kinds in ARGUMENTS.items()))


def test_each_named_fault_can_be_turned_on_and_off() -> None:
    mcu = FakeMcu(Config())
    before = dict(vars(mcu))
    for text in EACH:
        with mcu.switched_on(named(text)):
            assert vars(mcu) != before, text
        assert vars(mcu) == before, text


def test_a_fault_in_the_configuration_is_active_from_the_start() -> None:
    for text in EACH:
        mcu, faulty_mcu = FakeMcu(Config()), FakeMcu(Config(sim=SimConfig(faults=(text,))))
        with mcu.switched_on(named(text)):
            for switch in switches(Faults()):
                assert getattr(faulty_mcu, switch) == getattr(mcu, switch), (text, switch)


def test_several_faults_in_the_configuration_are_active_together() -> None:
    mcu = FakeMcu(Config(sim=SimConfig(faults=("ftdi", "stalls=5:0.15"))))
    assert (mcu.latency_ns, mcu.stall_every_ns, mcu.stall_ns) == (
        16_000_000, 5_000_000_000, 150_000_000,
    )  # fmt: skip
