"""Represents errors of a planar pose as motions in SE(2), in the axes of odom at the robot.

The error of an estimate is log(estimate^-1 truth): the constant twist that leads in one unit of
time from the estimated to the true pose. In the axes of base_link a step transforms it by the
adjoint of the step's inverse. In the axes of odom, whose direction is fixed, only the lever arm of
the step remains of that: `seen_from`.
"""

from __future__ import annotations

from acsard.core.values import PoseCovariance

Vector = tuple[float, float, float]
"""x, y (m) and yaw (rad) of an error."""

Planar = tuple[float, float]

ORIGIN: Vector = (0.0, 0.0, 0.0)


def plus(a: Vector, b: Vector) -> Vector:
    """Return a + b."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def bracket(a: Vector, b: Vector) -> Planar:
    """Return x and y of the Lie bracket [a, b]. Its yaw is always 0."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2]


def brackets(a: Vector, p: PoseCovariance, times: float) -> tuple[Vector, Vector]:
    """Return the rows of `times` E[[a, e] e'], where e has covariance `p`."""
    x, y, yaw = times * a[0], times * a[1], times * a[2]
    return (
        (y * p.xyaw - yaw * p.xy, y * p.yyaw - yaw * p.yy, y * p.yawyaw - yaw * p.yyaw),
        (yaw * p.xx - x * p.xyaw, yaw * p.xy - x * p.yyaw, yaw * p.xyaw - x * p.yawyaw),
    )


def bracket_covariance(p: PoseCovariance, q: PoseCovariance) -> Vector:
    """Return xx, xy and yy of E[[a, b] [a, b]'].

    The errors a and b are independent and have the covariances `p` and `q`.
    """
    return (
        p.yy * q.yawyaw - 2 * p.yyaw * q.yyaw + p.yawyaw * q.yy,
        p.yyaw * q.xyaw - p.xy * q.yawyaw - p.yawyaw * q.xy + p.xyaw * q.yyaw,
        p.yawyaw * q.xx - 2 * p.xyaw * q.xyaw + p.xx * q.yawyaw,
    )


def twice_bracketed(p: PoseCovariance, a: Vector) -> PoseCovariance:
    """Return E[[e, [e, b]] b'] plus its transpose.

    The error b has the covariance `p`, and `a` is E[e yaw].
    """
    x, y, yaw = a
    return PoseCovariance(
        2 * (x * p.xyaw - yaw * p.xx),
        x * p.yyaw + y * p.xyaw - 2 * yaw * p.xy,
        x * p.yawyaw - yaw * p.xyaw,
        2 * (y * p.yyaw - yaw * p.yy),
        y * p.yawyaw - yaw * p.yyaw,
        0.0,
    )


def seen_from(error: Vector, dx: float, dy: float) -> Vector:
    """Return the same error after the robot has moved by `dx`, `dy` m in odom."""
    x, y, yaw = error
    return x - dy * yaw, y + dx * yaw, yaw


def carried(p: PoseCovariance, dx: float, dy: float) -> PoseCovariance:
    """Return the covariance `p` of an error after the robot has moved by `dx`, `dy` m."""
    return PoseCovariance(
        p.xx - 2 * dy * p.xyaw + dy * dy * p.yawyaw,
        p.xy + dx * p.xyaw - dy * p.yyaw - dx * dy * p.yawyaw,
        p.xyaw - dy * p.yawyaw,
        p.yy + 2 * dx * p.yyaw + dx * dx * p.yawyaw,
        p.yyaw + dx * p.yawyaw,
        p.yawyaw,
    )


def added(
    p: PoseCovariance, along: float, yaw: float, both: float, c: float, s: float
) -> PoseCovariance:
    """Return `p` plus the noise of a step in direction (`c`, `s`): its variances and covariance."""
    cc, cs = along * c, along * s
    return PoseCovariance(
        p.xx + cc * c,
        p.xy + cc * s,
        p.xyaw + both * c,
        p.yy + cs * s,
        p.yyaw + both * s,
        p.yawyaw + yaw,
    )


def stepped(
    p: PoseCovariance,
    dx: float,
    dy: float,
    along: float,
    yaw: float,
    both: float,
    c: float,
    s: float,
) -> PoseCovariance:
    """Return `p` after a move by `dx`, `dy` m, plus the noise of that step.

    This is `carried` and `added` in one function, because each line takes a step.
    """
    xyaw, yyaw, yawyaw = p.xyaw, p.yyaw, p.yawyaw
    cc, cs = along * c, along * s
    return PoseCovariance(
        p.xx - 2 * dy * xyaw + dy * dy * yawyaw + cc * c,
        p.xy + dx * xyaw - dy * yyaw - dx * dy * yawyaw + cc * s,
        xyaw - dy * yawyaw + both * c,
        p.yy + 2 * dx * yyaw + dx * dx * yawyaw + cs * s,
        yyaw + dx * yawyaw + both * s,
        yawyaw + yaw,
    )


def total(p: PoseCovariance, q: PoseCovariance) -> PoseCovariance:
    """Return p + q."""
    return PoseCovariance(
        p.xx + q.xx,
        p.xy + q.xy,
        p.xyaw + q.xyaw,
        p.yy + q.yy,
        p.yyaw + q.yyaw,
        p.yawyaw + q.yawyaw,
    )


def difference(p: PoseCovariance, q: PoseCovariance) -> PoseCovariance:
    """Return p - q."""
    return PoseCovariance(
        p.xx - q.xx,
        p.xy - q.xy,
        p.xyaw - q.xyaw,
        p.yy - q.yy,
        p.yyaw - q.yyaw,
        p.yawyaw - q.yawyaw,
    )
