"""Calculates with the errors of a planar pose, which are elements of the Lie algebra of SE(2).

The error of an estimate, log(estimate^-1 truth), is the constant twist (x, y, yaw) that leads from
the estimated to the true pose in one unit of time. Its axes are parallel to odom with the origin at
the robot, so when the robot moves, only x and y change (`seen_from`); in base_link, it would change
by the adjoint. A covariance is of such a vector, E[...] an expected value, ' transposed, and [a, b]
the Lie bracket.
"""

from __future__ import annotations

from acsard.core.values import PoseCovariance

Vector = tuple[float, float, float]  # x, y (m) and yaw (rad)

Planar = tuple[float, float]  # x, y (m) of an error whose yaw is 0

ORIGIN: Vector = (0.0, 0.0, 0.0)


def plus(a: Vector, b: Vector) -> Vector:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def bracket(a: Vector, b: Vector) -> Planar:
    """Return x and y of the Lie bracket [a, b]; its yaw is always 0."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2]


def brackets(a: Vector, p: PoseCovariance, times: float) -> tuple[Vector, Vector]:
    """Return the rows x and y of E[[a, e] e'] `times`, for a fixed a and e of covariance `p`."""
    x, y, yaw = times * a[0], times * a[1], times * a[2]
    return (
        (y * p.xyaw - yaw * p.xy, y * p.yyaw - yaw * p.yy, y * p.yawyaw - yaw * p.yyaw),
        (yaw * p.xx - x * p.xyaw, yaw * p.xy - x * p.yyaw, yaw * p.xyaw - x * p.yawyaw),
    )


def bracket_covariance(p: PoseCovariance, q: PoseCovariance) -> Vector:
    """Return the covariance (xx, xy, yy) of [a, b], independent, of covariances `p` and `q`."""
    return (
        p.yy * q.yawyaw - 2 * p.yyaw * q.yyaw + p.yawyaw * q.yy,
        p.yyaw * q.xyaw - p.xy * q.yawyaw - p.yawyaw * q.xy + p.xyaw * q.yyaw,
        p.yawyaw * q.xx - 2 * p.xyaw * q.xyaw + p.xx * q.yawyaw,
    )


def twice_bracketed(p: PoseCovariance, a: Vector) -> PoseCovariance:
    """Return E[[e, [e, b]] b'] plus its transpose, for independent errors e and b.

    b has the covariance `p`, and `a` is the yaw column of the covariance of e.
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
    """Return what `error` becomes when the robot moves by `dx`, `dy` m in odom."""
    x, y, yaw = error
    return x - dy * yaw, y + dx * yaw, yaw


def carried(p: PoseCovariance, dx: float, dy: float) -> PoseCovariance:
    """Return what the covariance `p` becomes when the robot moves by `dx`, `dy` m in odom."""
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
    """Return `p` plus the noise of a step in the direction of cosine `c` and sine `s` in odom.

    The variances `along`, m2, and `yaw`, rad2, are of distance and turn, `both`, m rad, their
    covariance.
    """
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
    # This function runs for each feedback line, and is faster than the two calls.
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
    return PoseCovariance(
        p.xx + q.xx,
        p.xy + q.xy,
        p.xyaw + q.xyaw,
        p.yy + q.yy,
        p.yyaw + q.yyaw,
        p.yawyaw + q.yawyaw,
    )


def difference(p: PoseCovariance, q: PoseCovariance) -> PoseCovariance:
    return PoseCovariance(
        p.xx - q.xx,
        p.xy - q.xy,
        p.xyaw - q.xyaw,
        p.yy - q.yy,
        p.yyaw - q.yyaw,
        p.yawyaw - q.yawyaw,
    )
