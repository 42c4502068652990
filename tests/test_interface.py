"""No public name of the last release disappears without a word to its users."""

from __future__ import annotations

import re

from tests.pages import text_of
from tests.tools.interface import PUBLIC, names, names_of, released


def unannounced(before: set[str], now: set[str], changelog: str) -> set[str]:
    """Return the names that are gone, and that the newest section asks nobody to change."""
    section = re.split(r"^## ", changelog, flags=re.M)[1]
    asked = section.partition("### What an upgrade asks of you")[2]
    words = set(re.findall(r"`([^`]+)`", asked))
    return {name for name in before - now if not words & {name.rpartition("/")[2], name}}


def test_a_public_name_goes_only_if_the_changelog_says_what_to_write_instead() -> None:
    assert unannounced(released(), names(), text_of("CHANGELOG.md")) == set()


def test_a_name_that_is_gone_is_found_unless_the_upgrade_names_it() -> None:
    text = (
        "# Changelog\n\n## 0.3.0 (x)\n\n`old`\n\n### What an upgrade asks of you\n\n{}\n\n## 0.2.0"
    )
    before, now = {"settings/limits/old", "codes/a"}, {"codes/a", "codes/b"}
    assert unannounced(before, now, text.format("Nothing.")) == {"settings/limits/old"}
    assert not unannounced(before, now, text.format("Write `new` instead of `old`."))


def test_the_names_of_a_version_are_compared_with_those_of_the_release_before() -> None:
    assert len(released("0.3.0.dev0")) == len(released("0.3.0")) == 885
    assert "messages/SourceState/longest_gap" not in released("0.3.0")


def test_each_public_page_has_names_and_the_promise_names_each_page() -> None:
    found = names()
    assert {name.partition("/")[0] for name in found} == set(PUBLIC)
    assert len(found) > 600
    promise = text_of("SECURITY.md").partition("## Support")[2].partition("\n## ")[0]
    linked = set(re.findall(r"pages/reference/([\w-]+)\.md", promise))
    assert linked == set(PUBLIC)


def test_a_table_gives_its_names_without_values_and_arguments() -> None:
    page = "## limits\n\n| key | meaning |\n|---|---|\n| `--id ID` | `no` |\n| `a`, `b=1` | |\n"
    assert list(names_of("commands", page)) == [f"commands/limits/{x}" for x in ("--id", "a", "b")]
    assert list(names_of("python", "| `get(name: str)` | x |\n")) == ["python/get"]
    assert list(names_of("keys", "| `a\\|b` |\n| <code>a&#124;c</code> |\n")) == [
        "keys/a|b",
        "keys/a|c",
    ]
    row = "## A\n| `a` | `x`, `y` | text |\n"
    assert list(names_of("messages", row)) == ["messages/A/a", "messages/A/a/x", "messages/A/a/y"]
    assert list(names_of("http", "| `GET` | `/ws` | x |\n")) == ["http//ws"]
