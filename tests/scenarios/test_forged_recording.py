"""A replay finds reasons, names and events that somebody forged in a recording."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
from msgspec.structs import replace

from acsard.cli import main
from acsard.core.config.settings import Config
from acsard.core.values import Event
from acsard.host.errors import Exit
from acsard.recording.end_record import read_end
from acsard.recording.mcap_file import Recording, RecordingWriter, Topic
from acsard.recording.mcap_timeline import TimelineEntry
from acsard.recording.rows import NO_OCCASIONAL_FIELDS, Batch, OccasionalFields, Row
from tests.each import each, more
from tests.scenarios.taped import happenings, recorded_world

FORGERIES = [2, more(10)]
"""Number of random places at which each kind of forgery is tried."""

Messages = list[tuple[Topic, int, bytes]]

Forge = Callable[[Messages, random.Random], None]

BATCH = msgspec.msgpack.Decoder(Batch)


def forged_word(word: str, dice: random.Random) -> str:
    """Return the word with another letter at a random place, or a name if the word is empty."""
    if not word:
        return "anna"
    place = dice.randrange(len(word))
    letter = dice.choice([letter for letter in "aegmx7" if letter != word[place]])
    return word[:place] + letter + word[place + 1 :]


def forge_row(
    messages: Messages,
    dice: random.Random,
    forge: Callable[[OccasionalFields], OccasionalFields | None],
) -> None:
    """Replace one random row of the recorded steps by a forged one.

    `forge` returns the forged fields of a row, or None if the row has nothing to forge.
    """
    places: list[tuple[int, int, OccasionalFields]] = []
    for number, (topic, _, data) in enumerate(messages):
        if topic == "steps":
            for index, row in enumerate(BATCH.decode(data).rows):
                forged = forge(row.rare or NO_OCCASIONAL_FIELDS)
                if forged is not None:
                    places.append((number, index, forged))
    number, index, rare = dice.choice(places)
    topic, wall_ns, data = messages[number]
    batch = BATCH.decode(data)
    rows: list[Row] = list(batch.rows)
    rows[index] = replace(rows[index], rare=rare)
    forged_batch = msgspec.msgpack.encode(replace(batch, rows=tuple(rows)))
    messages[number] = topic, wall_ns, forged_batch


def forge_status(messages: Messages, dice: random.Random, place: int) -> None:
    """Forge one word of the status of one row. `place` is its index in the row's `status`."""

    def forge(rare: OccasionalFields) -> OccasionalFields | None:
        if rare.status is None:
            return None
        status = list(rare.status)
        status[place] = forged_word(status[place], dice)
        mode, reason, link, source, code = status
        return replace(rare, status=(mode, reason, link, source, code))

    forge_row(messages, dice, forge)


def forge_events(
    messages: Messages, dice: random.Random, forge: Callable[[list[Event]], list[Event]]
) -> None:
    """Forge the events of one row that has events."""
    forge_row(
        messages,
        dice,
        lambda rare: (
            replace(rare, events_out=tuple(forge(list(rare.events_out))))
            if rare.events_out
            else None
        ),
    )


def forge_one_event(
    messages: Messages, dice: random.Random, forge: Callable[[Event], Event]
) -> None:
    def forge_list(events: list[Event]) -> list[Event]:
        place = dice.randrange(len(events))
        return [*events[:place], forge(events[place]), *events[place + 1 :]]

    forge_events(messages, dice, forge_list)


def reason(messages: Messages, dice: random.Random) -> None:
    forge_status(messages, dice, 1)


def source(messages: Messages, dice: random.Random) -> None:
    forge_status(messages, dice, 3)


def code(messages: Messages, dice: random.Random) -> None:
    forge_status(messages, dice, 4)


def event_client(messages: Messages, dice: random.Random) -> None:
    forge_one_event(messages, dice, lambda event: replace(event, by=forged_word(event.by, dice)))


def event_text(messages: Messages, dice: random.Random) -> None:
    forge_one_event(
        messages, dice, lambda event: replace(event, text=forged_word(event.text, dice))
    )


def event_name(messages: Messages, dice: random.Random) -> None:
    names = ("stop", "fault", "clear", "mode")
    forge_one_event(
        messages,
        dice,
        lambda event: replace(event, name=dice.choice([n for n in names if n != event.name])),
    )


def removed_event(messages: Messages, dice: random.Random) -> None:
    def remove(events: list[Event]) -> list[Event]:
        del events[dice.randrange(len(events))]
        return events

    forge_events(messages, dice, remove)


def added_event(messages: Messages, dice: random.Random) -> None:
    added = Event("stop", "stopped; call srv/clear", by="anna")
    forge_row(messages, dice, lambda rare: replace(rare, events_out=(*rare.events_out, added)))


def input_name(field: str, part: str) -> Forge:
    """Return a function that forges a name in the recorded inputs of one step.

    It changes `part` of the first item in `field`. A replay may give the same outputs with a forged
    sender or refused source, so the replay must compare the names themselves.
    """

    def forge(messages: Messages, dice: random.Random) -> None:
        def forged(rare: OccasionalFields) -> OccasionalFields | None:
            if not (inputs := getattr(rare, field)):
                return None
            first, *others = inputs
            words: dict[str, Any] = {part: forged_word(getattr(first, part), dice)}
            changed: dict[str, Any] = {field: (replace(first, **words), *others)}
            return replace(rare, **changed)

        forge_row(messages, dice, forged)

    return forge


def copy(messages: Messages, dice: random.Random) -> None:
    """Forge an event in the topic `events`, which is a copy for the list of recordings."""
    places = [n for n, (topic, _, _) in enumerate(messages) if topic == "events"]
    number = dice.choice(places)
    topic, wall_ns, data = messages[number]
    entry = msgspec.json.decode(data, type=TimelineEntry)
    part = dice.choice(("name", "text", "by"))
    words: dict[str, Any] = {part: forged_word(getattr(entry, part), dice)}
    messages[number] = topic, wall_ns, msgspec.json.encode(replace(entry, **words))


def removed_copy(messages: Messages, dice: random.Random) -> None:
    del messages[dice.choice([n for n, message in enumerate(messages) if message[0] == "events"])]


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording with two sources, calls, refused commands, a lost port and a fault."""
    tape, world = recorded_world()
    world.drive(0.5, 0.3, 1.0, source="nav")
    happenings(world, random.Random(1))
    with world.mcu.stuck_encoder(0):
        world.drive(0.5, 0.4, 2.0)
    world.call("clear")
    path = tmp_path_factory.mktemp("original") / "000001-20270115T080000Z.mcap"
    tape.write(path, Config(), apart=False)
    return path


def forged_files(original: Path, path: Path, forge: Forge, count: int) -> Iterator[Path]:
    recording = Recording(original)
    for seed in range(count):
        messages = list(recording.messages())
        forge(messages, random.Random(seed))
        path.unlink(missing_ok=True)
        writing = RecordingWriter(path, recording.about)
        for topic, wall_ns, data in messages:
            if topic == "events":
                writing.event(msgspec.json.decode(data, type=TimelineEntry))
            else:
                writing.add(topic, wall_ns, data)
        writing.finish()
        yield path


@pytest.mark.slow
@pytest.mark.parametrize("count", FORGERIES)
@each(
    "forge",
    [
        reason, source, code, event_client, event_text, event_name, removed_event, added_event,
        input_name("requests", "by"), input_name("commands", "sender"),
        input_name("refusals", "source"), copy, removed_copy,
    ],
)  # fmt: skip
def test_a_replay_finds_every_forged_reason_name_and_event(
    original: Path,
    tmp_path: Path,
    forge: Forge,
    count: int,
    capsys: pytest.CaptureFixture[str],
) -> None:
    codes = Counter[int]()
    for path in forged_files(original, tmp_path / "000001-20270115T080000Z.mcap", forge, count):
        codes[main(["recording", "replay", str(path)])] += 1
    assert codes == {Exit.FAILURE: count}, capsys.readouterr().out[-2000:]


@pytest.mark.slow
def test_an_unforged_recording_replays_without_differences(
    original: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["recording", "replay", str(original)]) == Exit.OK, capsys.readouterr().out


def test_a_replay_finds_a_forged_summary_at_the_end_of_the_file(
    original: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data, end = original.read_bytes(), read_end(original)
    assert end is not None
    summary = end.said
    assert "unnamed" in summary
    at = data.rindex(summary.encode())
    forged = tmp_path / original.name
    name = summary.replace("unnamed", "unknown").encode()
    forged.write_bytes(data[:at] + name + data[at + len(name) :])
    assert main(["recording", "replay", str(forged)]) == Exit.FAILURE
    assert "(stopped by unknown (native))" in capsys.readouterr().out
