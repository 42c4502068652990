"""Tests of the JSON prompt: a program asks the operator through JSON lines in both directions."""

from __future__ import annotations

import fcntl
import io
import json
import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import Any

import pytest

from acsard.checkup.findings import Finding
from acsard.terminal import json_prompt
from acsard.terminal.json_prompt import MAX_LINE_BYTES, JsonPrompt
from acsard.terminal.prompt import NumberQuestion, ended_by_signals

DISTANCE = NumberQuestion("How far?", "m", 0.5, 3.0)
OPTIONAL = NumberQuestion("How far, if you like?", "m", 0.0, 3.0, 0.0)


class Program:
    """A parent program that answers the prompt's questions.

    It gives the next answer of a list to each question, and records every line in `said`.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        asked, self._to_child = os.pipe()
        self._from_child, writer = os.pipe()
        self._asked, self._told = os.fdopen(asked), os.fdopen(writer, "w")
        monkeypatch.setattr("sys.stdin", self._asked)
        self.said: list[dict[str, Any]] = []
        self.answers: list[object] = []
        self._thread = threading.Thread(target=self._answer, daemon=True)
        self._thread.start()

    def send(self, *messages: object, raw: bytes = b"") -> None:
        lines = b"".join(json.dumps(message).encode() + b"\n" for message in messages)
        os.write(self._to_child, raw + lines)

    @contextmanager
    def hears(self, person: JsonPrompt) -> Iterator[JsonPrompt]:
        """Send everything that the prompt prints on standard output to this program."""
        with redirect_stdout(self._told), person:
            yield person

    def hang_up(self) -> None:
        end, self._to_child = self._to_child, -1
        os.close(end)

    def close(self) -> None:
        for end in (self._asked, self._told):
            end.close()
        self._thread.join()
        if self._to_child >= 0:
            self.hang_up()

    def _answer(self) -> None:
        with os.fdopen(self._from_child) as lines:
            for line in lines:
                message = json.loads(line)
                self.said.append(message)
                if "question" in message and self.answers:
                    value = self.answers.pop(0)
                    if callable(value):
                        value(message["question"])
                    else:
                        self.send({"answer": message["question"], "value": value})

    def values_of(self, name: str) -> list[Any]:
        """Close the output, and return the value of this key in every message that has it."""
        self._told.close()
        self._thread.join()
        return [message[name] for message in self.said if name in message]


@pytest.fixture
def program(monkeypatch: pytest.MonkeyPatch) -> Iterator[Program]:
    program = Program(monkeypatch)
    yield program
    program.close()


def test_a_number_is_asked_for_until_it_is_valid_and_within_its_bounds(program: Program) -> None:
    program.answers = ["far", 0.1, -2, None, "1,75"]
    with program.hears(JsonPrompt()) as person:
        assert person.number(DISTANCE) == 1.75
    assert program.values_of("question") == [1, 2, 3, 4, 5]
    assert program.values_of("wrong") == ["type a number in m, from 0.5 to 3"] * 4
    assert {key: program.said[0][key] for key in ("words", "unit", "least", "most")} == {
        "words": "How far?", "unit": "m", "least": 0.5, "most": 3.0,
    }  # fmt: skip


def test_an_empty_answer_is_the_default(program: Program) -> None:
    program.answers = [None]
    with program.hears(JsonPrompt()) as person:
        assert person.number(OPTIONAL) == 0.0
    assert program.said[0]["usual"] == 0.0


def test_nothing_but_start_starts_a_leg_and_no_key_from_before_stops_it(program: Program) -> None:
    program.answers = ["go", "start"]
    with program.hears(JsonPrompt()) as person:
        program.send({"key": True})
        person.start("Go.", by_key=True)
        assert person.keys(0.05) == ""
    assert [message.get("leg") for message in program.said] == [True, True]
    assert program.said[0]["by_key"] is True
    assert program.said[1]["wrong"] == "answer with one of: start"


def test_a_key_right_after_the_start_stops(program: Program) -> None:
    def both(number: int) -> None:
        program.send({"answer": number, "value": "start"}, {"key": True})

    program.answers = [both]
    with program.hears(JsonPrompt()) as person:
        person.start("Go.")
        assert person.keys(5.0) == " "
        assert person.keys(0.01) == ""


def test_a_line_that_does_not_answer_the_question_leaves_it_open(program: Program) -> None:
    def noise(number: int) -> None:
        program.send(raw=b'\xff\n[]\n{"answer": "1"}\n{"answer": 1, "value": {}}\n\n')
        program.send({"answer": number + 1, "value": "start"}, {"answer": -1}, {})
        program.send({"answer": number, "value": "start", "more": 1})

    program.answers = [noise]
    with program.hears(JsonPrompt()) as person:
        person.start("Go.")
    assert program.values_of("question") == [1]


def interrupted(program: Program, do: Callable[[], object]) -> None:
    with ended_by_signals(), pytest.raises(KeyboardInterrupt):
        do()


def test_the_end_of_the_input_ends_the_prompt_also_without_a_question(program: Program) -> None:
    with program.hears(JsonPrompt()) as person:
        program.answers = [lambda number: program.hang_up()]
        interrupted(program, lambda: person.ask("lifted?", ("lifted",)))


def test_the_prompt_ends_even_if_standard_error_is_closed(
    program: Program, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The parent program has died, so its end of standard error is closed as well."""
    reader, writer = os.pipe()
    os.close(reader)
    pipe = open(writer, "wb", buffering=0)  # noqa: SIM115
    with pipe, program.hears(JsonPrompt()) as person:
        monkeypatch.setattr("sys.stderr", io.TextIOWrapper(pipe, write_through=True))
        program.answers = [lambda number: program.hang_up()]
        interrupted(program, lambda: person.ask("lifted?", ("lifted",)))


def test_the_prompt_ends_even_if_its_output_is_not_read(program: Program) -> None:
    """The parent program hangs, so that its pipe fills, and later ends."""
    reader, writer = os.pipe()
    fcntl.fcntl(writer, fcntl.F_SETPIPE_SZ, 4096)
    os.write(writer, b"x" * 4096)
    with os.fdopen(reader), os.fdopen(writer, "w") as full:
        with redirect_stdout(full), JsonPrompt() as person:
            hangs_up = threading.Timer(0.3, program.hang_up)
            hangs_up.start()
            interrupted(program, lambda: person.ask("lifted?", ("lifted",)))
            hangs_up.join()
        os.read(reader, 4096)


def test_a_line_with_too_deep_nesting_leaves_the_question_open(program: Program) -> None:
    with program.hears(JsonPrompt()) as person:

        def nested(number: int) -> None:
            program.send(raw=b'{"x":' + b"[" * 30_000 + b"\n")
            program.send({"answer": number, "value": "lifted"})

        program.answers = [nested]
        assert person.ask("lifted?", ("lifted",)) == "lifted"


def test_a_line_without_an_end_ends_the_prompt(
    program: Program, capfd: pytest.CaptureFixture[str]
) -> None:
    with program.hears(JsonPrompt()) as person:

        def flood(number: int) -> None:
            for _ in range(MAX_LINE_BYTES // 4096 + 1):
                program.send(raw=b"x" * 4096)

        program.answers = [flood]
        interrupted(program, lambda: person.ask("lifted?", ("lifted",)))
    assert "a line on standard input has more than 65536 bytes" in capfd.readouterr().err


def test_silence_of_the_program_ends_a_motion_and_keepalives_continue_it(
    program: Program, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(json_prompt, "MAX_INPUT_SILENCE_S", 0.25)
    monkeypatch.setattr(json_prompt, "POLL_S", 0.02)
    program.answers = ["start"]
    with program.hears(JsonPrompt()) as person:
        person.start("Go.")
        for _ in range(10):
            program.send({})
            assert person.keys(0.05) == ""
        interrupted(program, lambda: person.keys(60.0))
    assert (
        "the operator's page or program sent no sign of life for 0.25 s" in capfd.readouterr().err
    )


def test_a_question_waits_without_a_timeout(
    program: Program, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(json_prompt, "MAX_INPUT_SILENCE_S", 0.05)
    monkeypatch.setattr(json_prompt, "POLL_S", 0.01)

    def late(number: int) -> None:
        threading.Timer(0.3, program.send, [{"answer": number, "value": 1.0}]).start()

    program.answers = ["start", late]
    with program.hears(JsonPrompt()) as person:
        person.start("Go.")
        assert person.number(DISTANCE) == 1.0


def test_findings_are_reported_as_they_are_made_with_the_progress(program: Program) -> None:
    with program.hears(JsonPrompt()) as person:
        person.begin("port sim", simulated=True)
        person.doing("a motor turns")
        for _ in range(20):
            person.show_finding(Finding("baud rate", "PASS", "115200 baud"))
    assert program.values_of("doing") == ["a motor turns"]
    assert program.said[0] == {"subject": "port sim", "simulated": True}
    assert program.values_of("finding")[0]["figure"] == "115200 baud"
    shares = program.values_of("progress")
    assert shares == sorted(shares)
    assert max(shares) < 1.0


def test_the_result_ends_the_progress(program: Program) -> None:
    with program.hears(JsonPrompt()) as person:
        person.progress(0.5)
        person.result("\nall of it\n")
    assert program.values_of("progress") == [0.5, 1.0]
    assert program.said[-1] == {"result": "all of it"}


OFFERED = {"mcu.baud_rate": 57600}


@pytest.mark.parametrize(("answer", "text"), [("write", "57600"), ("leave", "# mine\n")])
def test_the_offered_lines_are_written_only_if_the_answer_is_write(
    program: Program, tmp_path: Path, answer: str, text: str
) -> None:
    file = tmp_path / "acsard.toml"
    file.write_text("# mine\n")
    program.answers = [answer]
    with program.hears(JsonPrompt()) as lines:
        assert lines.offer(str(file), OFFERED) == (answer == "write")
    assert str(file) in program.said[0]["words"]
    assert file.read_text().startswith("# mine\n")
    assert text in file.read_text()


def test_an_unwritable_result_is_not_offered_and_has_a_reason(
    program: Program, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("ACSARD_CONFIG", raising=False)
    monkeypatch.setattr("acsard.host.config_file.SEARCH_PATHS", (Path("acsard.toml"),))
    with program.hears(JsonPrompt()) as lines:
        assert not lines.offer(None, OFFERED)
        assert not lines.offer(None, OFFERED, "the daemon runs with another")
    assert program.values_of("question") == []
    first, second = program.values_of("message")
    assert "no configuration file" in first
    assert "the daemon runs with another" in second
