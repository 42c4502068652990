"""Tests of the permissions of roles that follow from the table of keys."""

from __future__ import annotations

import pytest

from acsard.core.messages.keys_and_roles import FOLLOWED, PUBLISHED, TOPICS
from acsard.core.messages.permissions import (
    USES,
    has,
    keys_for,
    least_role,
)
from acsard.core.values import ROLES, Role
from tests.each import each


@pytest.mark.parametrize("role", ["", *ROLES])
def test_a_role_has_its_own_permissions_and_those_of_lower_roles(role: str) -> None:
    assert [least for least in ROLES if has(role, least)] == list(
        ROLES[: ROLES.index(role) + 1] if role in ROLES else ()
    )


def test_each_row_has_a_role_for_exactly_the_uses_of_its_direction() -> None:
    for row in TOPICS:
        if row in FOLLOWED or row.key in ("json/<key>", "alive"):
            assert row.subscribe == "viewer"
        else:
            assert row.subscribe is None
        assert (row.publish is not None) == (row.direction == "in"), row.key
        if row.direction in ("query", "service"):
            assert row.query is not None, row.key


def test_a_key_of_the_robot_s_own_machine_is_granted_to_no_role() -> None:
    granted = {key for role in ROLES for use in USES for key in keys_for(role, use, TOPICS)}
    assert "gateway" not in granted
    assert not any(key.startswith(("cmd/", "wheel_cmd/")) for key in granted)


def test_a_published_key_is_granted_together_with_its_json_key() -> None:
    assert set(keys_for("viewer", "subscribe", PUBLISHED)) == {
        key for topic in PUBLISHED for key in (topic.key, f"json/{topic.key}")
    }


@each(
    ("key", "role"),
    [
        ("odom", "viewer"),
        ("json/sim/pose", "viewer"),
        ("alive", "viewer"),
        ("stop", "viewer"),
        ("cmd/app", "operator"),
        ("wheel_cmd/app/anna", "operator"),
        ("srv/clear", "operator"),
        ("imu", "maintainer"),
        ("config", "maintainer"),
        ("whoami/operator", "operator"),
    ],
)
def test_a_key_has_the_expected_least_role(key: str, role: Role) -> None:
    assert least_role(key) == role


@pytest.mark.parametrize(
    "key", ["", "no/such/key", "cmd/", "cmd/a/b/c", "json/nonsense", "whoami/admin"]
)
def test_no_role_may_use_an_unknown_key(key: str) -> None:
    with pytest.raises(LookupError, match="no row"):
        least_role(key)
