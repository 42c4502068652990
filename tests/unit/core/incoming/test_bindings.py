"""A sender id belongs to the certificate under which it was first seen."""

from __future__ import annotations

from acsard.core.incoming.commands import BOUND_NS, MAX_BOUND, Bindings


def test_the_first_certificate_keeps_the_sender_for_as_long_as_it_speaks() -> None:
    bindings = Bindings()
    for at_ns in range(0, 5 * BOUND_NS, BOUND_NS // 2):
        assert bindings.other("a", "anna", at_ns) is None
        assert bindings.other("a", "ben", at_ns + 1) == "anna"
        assert bindings.other("a", "", at_ns + 1) == "anna"
    assert bindings.other("b", "ben", at_ns) is None


def test_this_machine_is_a_place_like_a_certificate() -> None:
    bindings = Bindings()
    assert bindings.other("a", "", 0) is None
    assert bindings.other("a", "anna", 1) == ""


def test_refused_commands_do_not_lengthen_the_binding_and_after_a_silence_it_ends() -> None:
    bindings = Bindings()
    bindings.other("a", "anna", 0)
    assert bindings.other("a", "ben", BOUND_NS) == "anna"
    assert bindings.other("a", "ben", BOUND_NS + 1) is None
    assert bindings.other("a", "anna", BOUND_NS + 2) == "ben"


def test_a_flood_of_sender_ids_takes_no_memory_and_those_that_speak_stay_bound() -> None:
    bindings = Bindings()
    bindings.other("a", "anna", 0)
    for number in range(4 * MAX_BOUND):
        bindings.other(f"other {number}", "ben", number)
        if number % 100 == 0:
            assert bindings.other("a", "anna", number) is None
    assert bindings.other("a", "ben", number) == "anna"
    assert len(bindings._seen) <= MAX_BOUND
