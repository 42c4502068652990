"""The daemon names the changed settings that its next start would lose.

It writes them to the configuration file on request.
"""

from __future__ import annotations

import errno
import io
import os
import subprocess
import sys
import threading
import tracemalloc
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import msgspec
import pytest
from msgspec.structs import replace

from acsard.core.config.parsing import parse
from acsard.core.config.settings import Config
from acsard.core.values import Answer, Event, Plain, Request
from acsard.daemon import settings_file as module
from acsard.daemon.settings_file import SettingsFile, keeps
from acsard.host import config_edit_process, config_file
from acsard.host.config_edit_process import edited_in_process
from acsard.host.config_file import Edit
from acsard.host.errors import MendableError
from tests.system.harness import until

TEXT = "[limits]\nlinear_speed = 0.5\n"
LOWERED = "limits.linear_speed = 0.3, not 0.5"

Started = Callable[..., SettingsFile]


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> Iterator[Started]:
    """Yield a function that starts to watch a file. End all watches after the test."""
    monkeypatch.setattr(module, "CHECK_PERIOD_S", 0.01)
    # A busy machine starts the process of an edit slowly.
    monkeypatch.setattr("acsard.host.config_edit_process.EDIT_TIMEOUT_S", 30.0)
    files: list[SettingsFile] = []

    def start(file: Path | None, config: Config, options: dict[str, object]) -> SettingsFile:
        made = SettingsFile(file, lambda text: parse(text, {"limits": options}), config)
        files.append(made)
        made.start()
        return made

    yield start
    for watch in files:
        watch.close()


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """Return a configuration file with `TEXT`."""
    path = tmp_path / "acsard.toml"
    path.write_text(TEXT)
    return path


@pytest.fixture
def made(file: Path, started: Started) -> SettingsFile:
    """Return the settings file of a daemon that has started with `file`."""
    return started(file, parse(TEXT.encode()), {})


def with_speed(config: Config, speed: float) -> Config:
    return replace(config, limits=replace(config.limits, linear_speed=speed))


def test_a_setting_that_was_changed_is_named_until_it_is_changed_back(
    file: Path, made: SettingsFile
) -> None:
    config = parse(file.read_bytes())
    made.use(with_speed(config, 0.3))
    until(lambda: made.differ == LOWERED)
    made.use(config)
    until(lambda: made.differ == "")


def test_an_edited_file_is_compared_again(file: Path, started: Started) -> None:
    made = started(file, with_speed(parse(TEXT.encode()), 0.3), {})
    until(lambda: made.differ == LOWERED)
    file.write_text(TEXT.replace("0.5", "0.30"))
    until(lambda: made.differ == "")


def test_an_option_of_the_daemon_is_not_reported_as_a_difference(
    file: Path, started: Started
) -> None:
    options: dict[str, object] = {"linear_speed": 0.4}
    config = parse(TEXT.encode(), {"limits": options})
    made = started(file, config, options)
    made.use(with_speed(config, 0.3))
    until(lambda: made.differ == LOWERED.replace("0.5", "0.4"))
    made.use(config)
    until(lambda: made.differ == "")


def test_a_daemon_without_a_file_is_compared_with_its_start(started: Started) -> None:
    made = started(None, Config(), {})
    made.use(with_speed(Config(), 0.3))
    until(lambda: "linear_speed = 0.3, not" in made.differ)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (b"[limits\n", "the daemon could not start with the present content of its file: not TOML"),
        (
            b"[limits]\nlinear_sped = 1\n",
            "the daemon could not start with the present content of its file: limits.",
        ),
        (None, "the configuration file cannot be read: No such file or directory"),
    ],
)
def test_a_file_with_which_the_daemon_cannot_start_is_reported(
    file: Path, made: SettingsFile, text: bytes | None, words: str
) -> None:
    if text is None:
        file.unlink()
    else:
        file.write_bytes(text)
    until(lambda: made.differ.startswith(words))
    file.write_text(TEXT)
    until(lambda: made.differ == "")


def test_the_text_is_short_when_every_setting_differs(tmp_path: Path, started: Started) -> None:
    file = tmp_path / "acsard.toml"
    file.write_text(
        "[limits]\n"
        + "".join(
            f"{name} = {getattr(Config().limits, name) * 0.9 + 0.1}\n"
            for name in Config().limits.__struct_fields__
        )
    )
    made = started(file, Config(), {})
    until(lambda: " more" in made.differ)
    assert len(made.differ) <= module.MAX_TEXT_LENGTH


# a `set` that is to be kept

REQUEST = Request("set", 7, by="anna", settings={"limits.linear_speed": 0.8})
OBEYED = Answer(7, True, "limits.linear_speed = 0.8 (was 0.5)")


def result(made: SettingsFile, events: list[Event] | None = None) -> Request | Answer:
    """Return the next result, at a time when no answer is overdue."""
    results: list[Request | Answer] = []

    def look() -> bool:
        results.extend(made.results(0, [] if events is None else events))
        return bool(results)

    until(look)
    (outcome,) = results
    return outcome


def check(made: SettingsFile) -> None:
    """Request to write a change that the file accepts."""
    made.keep(REQUEST, 0)
    assert result(made) is REQUEST


def refusal(made: SettingsFile) -> str:
    """Return the text of the next result, which is a refusal."""
    answer = result(made)
    assert isinstance(answer, Answer)
    assert not answer.success
    return answer.message


@pytest.mark.slow
def test_a_setting_is_written_after_the_robot_has_obeyed(tmp_path: Path, started: Started) -> None:
    file = tmp_path / "acsard.toml"
    file.write_text(f"# mine\n{TEXT}")
    config, events = parse(file.read_bytes()), list[Event]()
    made = started(file, config, {})
    check(made)
    assert file.read_text() == f"# mine\n{TEXT}"
    made.use(with_speed(config, 0.8))
    assert made.defers_answer(OBEYED)
    assert result(made, events) == Answer(7, True, f"{OBEYED.message}; written to {file}")
    assert file.read_text() == f"# mine\n{TEXT.replace('0.5', '0.8')}"
    (event,) = events
    assert (event.name, event.by) == ("set", "anna")
    assert event.text == f"limits.linear_speed to {file}"
    until(lambda: made.differ == "")
    assert made.results(10**12, events) == []
    assert os.listdir(tmp_path) == ["acsard.toml"]


def test_a_setting_that_the_robot_refuses_is_not_written(file: Path, made: SettingsFile) -> None:
    check(made)
    assert not made.defers_answer(Answer(7, False, "stop the robot first"))
    assert made.results(10**12, []) == []
    assert file.read_text() == TEXT


def test_an_answer_to_another_request_does_not_change_the_file(started: Started) -> None:
    assert not started(None, Config(), {}).defers_answer(OBEYED)


def read_only(file: Path) -> None:
    file.chmod(0o444)


def broken(file: Path) -> None:
    file.write_text("[limits\n")


def tracked(file: Path) -> None:
    for words in (["init", "-q"], ["add", file.name]):
        subprocess.run(["git", *words], cwd=file.parent, check=True)


@pytest.mark.parametrize(
    ("spoil", "settings", "words", "by_hand"),
    [
        (read_only, {}, "it is read-only for the daemon", True),
        (broken, {}, "was not changed: not TOML", False),
        (tracked, {}, "git tracks it", False),
        (
            None,
            {"commands.sources.app.timeout": 0.3},
            "cannot write a timeout of [[commands.sources]] to a file",
            True,
        ),
    ],
)
def test_nothing_is_set_if_the_file_cannot_be_changed(
    file: Path,
    made: SettingsFile,
    spoil: Callable[[Path], None] | None,
    settings: dict[str, Plain],
    words: str,
    by_hand: bool,
) -> None:
    if spoil is not None:
        spoil(file)
    before = file.read_text()
    made.keep(replace(REQUEST, settings=settings or REQUEST.settings), 0)
    message = refusal(made)
    assert message.startswith("no setting was changed: ")
    assert words in message
    assert ("edit the file by hand" in message) is by_hand, "one remedy, which fits"
    assert file.read_text() == before


def test_nothing_is_set_if_the_daemon_has_no_file(started: Started) -> None:
    made = started(None, Config(), {})
    made.keep(REQUEST, 0)
    answer = result(made)
    assert isinstance(answer, Answer)
    assert answer.message.startswith(
        "no setting was changed: the daemon runs without a configuration file"
    )


@pytest.mark.slow
def test_an_untracked_file_beside_tracked_ones_is_changed(tmp_path: Path, started: Started) -> None:
    other, file = tmp_path / "tracked.toml", tmp_path / "acsard.toml"
    other.write_text(TEXT)
    tracked(other)
    file.write_text(TEXT)
    made = started(file, parse(TEXT.encode()), {})
    check(made)


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("limits.linear_sped", 1.0, "limits.linear_sped"),
        ("mcu.baud_rate", 9600, "read only when the daemon starts"),
        ("limits.linear_speed", -1.0, "limits.linear_speed"),
    ],
)
def test_settings_that_the_robot_would_refuse_are_refused_in_its_words(
    tmp_path: Path, started: Started, key: str, value: float, words: str
) -> None:
    made = started(tmp_path / "absent.toml", Config(), {})
    made.keep(replace(REQUEST, settings={key: value}), 0)
    message = refusal(made)
    assert words in message
    assert "absent.toml" not in message


@pytest.mark.slow
def test_a_file_that_changes_between_check_and_writing_keeps_both_changes(
    file: Path, made: SettingsFile
) -> None:
    check(made)
    file.write_text(f"# new\n{TEXT}[rates]\nstate = 5.0\n")
    assert made.defers_answer(OBEYED)
    assert result(made) == Answer(7, True, f"{OBEYED.message}; written to {file}")
    assert file.read_text() == f"# new\n{TEXT.replace('0.5', '0.8')}[rates]\nstate = 5.0\n"


@pytest.mark.slow
def test_a_failed_write_after_the_robot_has_obeyed_is_reported_as_a_failure(
    file: Path, made: SettingsFile
) -> None:
    check(made)
    read_only(file)
    assert made.defers_answer(OBEYED)
    message = refusal(made)
    only = "but only until the daemon's next start, because"
    assert message.startswith(f"{OBEYED.message}, {only} {file} was not")


@pytest.mark.parametrize("obeyed", [False, True])
def test_a_disk_that_hangs_gets_an_answer_and_a_late_result_changes_nothing(
    file: Path, made: SettingsFile, monkeypatch: pytest.MonkeyPatch, obeyed: bool
) -> None:
    begun, hangs = threading.Event(), threading.Event()

    def hang(*_: object) -> Edit:
        begun.set()
        hangs.wait()
        return Edit(file, {}, b"", "")

    if obeyed:
        check(made)
    monkeypatch.setattr(module, "apply_edit", hang)
    monkeypatch.setattr(module, "prepare_edit", hang)
    if obeyed:
        assert made.defers_answer(OBEYED)
    else:
        made.keep(REQUEST, 0)
    assert begun.wait(10.0)
    assert made.results(module.REPLY_TIMEOUT_NS, []) == []
    (answer,) = made.results(module.REPLY_TIMEOUT_NS + 1, [])
    assert isinstance(answer, Answer)
    assert not answer.success
    assert "the disk did not answer within 2.5 s" in answer.message
    assert answer.message.startswith(OBEYED.message if obeyed else "no setting was changed")
    hangs.set()
    until(lambda: made._results.waiting)
    assert made.results(0, []) == []


def test_a_thread_that_cannot_be_started_is_named_in_the_answer_at_once(
    file: Path, started: Started, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "start", full)
        made = started(file, parse(TEXT.encode()), {})
    assert "can't start new thread" in made.differ
    assert made.keep(REQUEST, 0) == Answer(
        REQUEST.id,
        False,
        "no setting was changed: the daemon could not start the thread that compares "
        "and changes the file (can't start new thread); restart acsard, or send the request "
        "without `keep`",
    )
    assert made.results(module.REPLY_TIMEOUT_NS + 1, []) == []


@pytest.mark.parametrize("fails", [False, True])
def test_a_write_that_ends_after_its_overdue_answer_is_logged_also_if_it_fails(
    file: Path, made: SettingsFile, monkeypatch: pytest.MonkeyPatch, fails: bool
) -> None:
    hangs, events = threading.Event(), list[Event]()

    def hang(edit: Edit) -> None:
        hangs.wait()
        if fails:
            raise MendableError("the disk is full")

    check(made)
    monkeypatch.setattr(module, "apply_edit", hang)
    assert made.defers_answer(OBEYED)
    late_ns = module.REPLY_TIMEOUT_NS + 1
    (answer,) = made.results(late_ns, events)
    assert isinstance(answer, Answer)
    assert "check whether the file has the new value" in answer.message
    assert made.results(late_ns, events) == [], "each request has only one answer"
    assert events == []
    hangs.set()
    until(lambda: made._results.waiting)
    assert made.results(late_ns, events) == []
    (event,) = events
    assert (event.name, event.by) == ("set", "anna")
    text = f"limits.linear_speed to {file}"
    if fails:
        assert (event.kind, event.level) == ("not written", "warning")
        assert event.text.startswith(f"{text}: ")
        assert "the disk is full" in event.text
    else:
        assert (event.kind, event.text) == ("written", text)
    assert made.results(late_ns, events) == []
    assert events == [event]


@pytest.mark.slow
def test_a_request_that_the_robot_received_is_not_reported_as_not_set(made: SettingsFile) -> None:
    """While a speed limit applies, a `set` request may wait for a further step."""
    check(made)
    assert made.results(module.REPLY_TIMEOUT_NS + 1, []) == []
    assert made.defers_answer(OBEYED)


def test_keep_is_recognized_in_every_notation() -> None:
    text = rb'{"settings": {"limits.linear_speed": 0.8}, "\u006beep": true}'
    assert keeps("application/json", text)
    assert not keeps("application/json", text.replace(b"true", b"false"))


def test_a_pipe_in_place_of_the_file_is_not_read(file: Path, made: SettingsFile) -> None:
    file.unlink()
    os.mkfifo(file)
    until(lambda: made.differ == "the configuration file cannot be read: it is not a regular file")
    made.keep(REQUEST, 0)
    answer = result(made)
    assert isinstance(answer, Answer)
    assert "it is not a regular file" in answer.message


def test_a_huge_file_is_reported_without_being_read_to_its_end(
    file: Path, made: SettingsFile
) -> None:
    tracemalloc.start()
    try:
        os.truncate(file, 1 << 26)
        until(lambda: "too large for a configuration" in made.differ)
        assert tracemalloc.get_traced_memory()[1] < 1 << 23
    finally:
        tracemalloc.stop()
    file.write_text(TEXT)
    until(lambda: made.differ == "")


def test_a_loop_of_symbolic_links_in_place_of_the_file_is_reported_until_it_is_gone(
    file: Path, made: SettingsFile
) -> None:
    file.unlink()
    file.symlink_to(file)
    made.keep(REQUEST, 0)
    assert "Too many levels of symbolic links" in refusal(made)
    until(lambda: "Too many levels of symbolic links" in made.differ)
    file.unlink()
    file.write_text(TEXT)
    until(lambda: made.differ == "")


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_thread_that_has_ended_is_reported_and_named_in_the_answer_at_once(
    made: SettingsFile, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object) -> Edit:
        raise RuntimeError("a defect")

    monkeypatch.setattr(module, "prepare_edit", fails)
    made.keep(REQUEST, 0)
    ended = "the thread that compares and changes the file has ended"
    until(lambda: ended in made.differ)
    assert made.differ.endswith("; restart acsard")
    (answer,) = made.results(module.REPLY_TIMEOUT_NS + 1, [])
    assert isinstance(answer, Answer)
    assert answer.message.startswith(f"no setting was changed: {ended}; restart acsard")
    assert made.keep(replace(REQUEST, id=8), 0) == Answer(
        8,
        False,
        f"no setting was changed: {ended}; restart acsard, or send the request without `keep`",
    )


@pytest.mark.slow
def test_a_request_that_is_checked_too_late_is_not_obeyed(made: SettingsFile) -> None:
    made.keep(REQUEST, 0)
    until(lambda: made._results.waiting)
    (answer,) = made.results(module.REPLY_TIMEOUT_NS + 1, [])
    assert isinstance(answer, Answer)
    assert not answer.success
    assert answer.message.startswith("no setting was changed")


def test_too_many_requests_are_refused_and_overdue_ones_take_no_more_time(
    file: Path, started: Started, monkeypatch: pytest.MonkeyPatch
) -> None:
    hangs, checked = threading.Event(), list[object]()

    def slow(*words: object) -> Edit:
        checked.append(words)
        hangs.wait()
        return Edit(file, {}, b"", "")

    monkeypatch.setattr(module, "prepare_edit", slow)
    made = started(file, Config(), {})
    for number in range(1, module.MAX_JOBS + 1):
        assert made.keep(replace(REQUEST, id=number), 0) is None
    for number in range(module.MAX_JOBS + 1, module.MAX_JOBS + 11):
        refusal = made.keep(replace(REQUEST, id=number), 0)
        assert refusal is not None
        assert refusal.id == number
        assert "more than 32 changes of the file wait" in refusal.message
    until(lambda: checked)
    assert made.results(0, []) == []
    assert len(made.results(module.REPLY_TIMEOUT_NS + 1, [])) == module.MAX_JOBS
    hangs.set()
    until(lambda: not made._box.waiting)
    made.keep(replace(REQUEST, id=99), 0)
    assert result(made) == replace(REQUEST, id=99)
    assert len(checked) == 2  # the first one, which hung, and the last one


@pytest.mark.slow
def test_changed_settings_do_not_displace_a_change_of_the_file(
    file: Path, made: SettingsFile, monkeypatch: pytest.MonkeyPatch
) -> None:
    hangs = threading.Event()
    config = parse(TEXT.encode())
    check(made)
    read = SettingsFile._read
    monkeypatch.setattr(SettingsFile, "_read", lambda self: hangs.wait() and read(self))
    assert made.defers_answer(OBEYED)
    for _ in range(2 * module.MAX_JOBS):
        made.use(with_speed(config, 0.8))
    hangs.set()
    assert result(made) == Answer(7, True, f"{OBEYED.message}; written to {file}")


@pytest.mark.slow
def test_a_change_that_the_robot_has_obeyed_is_written_before_the_next_check(
    file: Path, made: SettingsFile, monkeypatch: pytest.MonkeyPatch
) -> None:
    hangs, done = threading.Event(), list[str]()
    check(made)

    def slow(*_: object) -> Edit:
        done.append("check")
        hangs.wait()
        return Edit(file, {}, b"", "")

    monkeypatch.setattr(module, "prepare_edit", slow)
    monkeypatch.setattr(module, "apply_edit", lambda edit: done.append("write"))
    for number in (8, 9):
        made.keep(replace(REQUEST, id=number), 0)
    until(lambda: done)
    assert made.defers_answer(OBEYED)
    hangs.set()
    until(lambda: len(done) == 3)
    assert done == ["check", "write", "check"]


@pytest.mark.slow
def test_an_edit_during_the_computation_of_a_change_is_not_lost(
    file: Path, made: SettingsFile, monkeypatch: pytest.MonkeyPatch
) -> None:
    texts = ["# second\n"]
    check(made)

    def edited(text: str, keys: Mapping[str, object]) -> str:
        changed = edited_in_process(text, keys)
        if texts:
            file.write_text(texts.pop() + file.read_text())
        return changed

    monkeypatch.setattr(config_file, "edited_in_process", edited)
    file.write_text(f"# first\n{TEXT}")
    assert made.defers_answer(OBEYED)
    answer = result(made)
    assert isinstance(answer, Answer)
    assert answer.success
    assert file.read_text() == f"# second\n# first\n{TEXT.replace('0.5', '0.8')}"


@pytest.mark.slow
def test_the_directory_is_on_the_disk_before_the_answer(
    tmp_path: Path, file: Path, made: SettingsFile, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced = list[tuple[Path, bool]]()

    def sync(path: Path) -> None:
        synced.append((path, "0.8" in file.read_text()))
        raise OSError(errno.EINVAL, "this file system cannot")

    monkeypatch.setattr(config_file, "sync", sync)
    check(made)
    assert made.defers_answer(OBEYED)
    answer = result(made)
    assert isinstance(answer, Answer)
    assert answer.success
    assert synced == [(tmp_path, True)]


def test_the_text_is_computed_where_the_priority_cannot_be_lowered(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The service's systemd unit blocks this system call, and the daemon must work without it."""

    def refuse(increment: int) -> int:
        raise PermissionError(errno.EPERM, os.strerror(errno.EPERM))

    task = msgspec.json.encode(config_edit_process.Task(TEXT, {"limits.linear_speed": 0.8}))
    stdin, answer = io.TextIOWrapper(io.BytesIO(task)), io.TextIOWrapper(io.BytesIO())
    monkeypatch.setattr(os, "nice", refuse)
    monkeypatch.setattr(sys, "stdin", stdin)
    monkeypatch.setattr(sys, "stdout", answer)
    config_edit_process.main()
    answer.seek(0)
    made = msgspec.json.decode(answer.read(), type=config_edit_process.Result)
    assert made == config_edit_process.Result(TEXT.replace("0.5", "0.8"))


def test_git_does_not_read_the_repository_of_another_user(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A repository's configuration can name programs that git runs.

    They would run with the daemon's rights.
    """
    tracked(file)
    assert config_file.is_tracked(file)
    monkeypatch.setenv("GIT_TEST_ASSUME_DIFFERENT_OWNER", "1")
    assert not config_file.is_tracked(file)
