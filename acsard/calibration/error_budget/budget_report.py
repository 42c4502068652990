"""An error budget as text: a table for people, and advice on the largest error."""

from __future__ import annotations

from collections.abc import Iterator

from rich.console import RenderableType
from rich.table import Table

from acsard.calibration.error_budget.budget import Basis, Budget, Cause, Share
from acsard.core.motion.uncertainty import COARSE_COUNTS
from acsard.terminal.output import table

MEANING: dict[Cause, str] = {
    "time": "errors in the times of the lines",
    "quantisation": "rounding of the values in a line",
    "gaps": "distance driven while no lines came",
    "slip": "wheels that skid",
    "parameters": "wheel radii and track",
    "gyro": "bias, noise and scale of the gyro",
}

MENDS: dict[Cause, str] = {
    "time": "lines are late by {late:.1f} ms: set the adapter's latency_timer to 1 (the udev "
    "rules do that), or let the lines carry the microcontroller's clock and counts "
    "(mcu.link_check, mcu.encoder_counts)",
    "gaps": "{missing} lines were lost, so {unseen:.2f} s of driving were not measured: look "
    "for a loose cable, noise on the wire or a busy machine (`acsard top`), or let the "
    "lines carry counts, which lose no distance (mcu.link_check, mcu.encoder_counts)",
    "slip": "drive on other ground or turn less on the spot; a gyro measures turns that "
    "skidding wheels do not show ([odometry] gyro)",
    "parameters": "run `acsard calibrate`: it measures wheel radii and effective track",
    "gyro": "let the robot stand for a second now and then, so that it learns the gyro's bias",
}

TOLD: dict[Basis, str] = {
    "measured": "measurements",
    "settings": "[odometry]",
    "unknown": "nothing",
}

CALIBRATE = (
    "the error of wheel radii and track width is unknown, and on wheels that skid it is mostly "
    "the largest: run `acsard calibrate`"
)
"""Advice while the robot is not calibrated."""


def parts(budget: Budget) -> Iterator[RenderableType]:
    """Yield the table, the data that it is based on, and advice on the largest share."""
    if budget.still:
        yield _standing(budget)
    else:
        yield from (_driven(budget), "", _table(budget))
    if budget.learned is not None:
        yield from ("", _track(budget, budget.learned))
    sentence = advice(budget)
    yield from ("", f"{sentence[0].upper()}{sentence[1:]}.")


def advice(budget: Budget) -> str:
    """Return advice on the largest measured share, and on a declared one that is larger."""
    if budget.still:
        return (
            "drive the robot, also around curves, while this measures: most causes show only then"
        )
    seen, all_ = budget.largest("measured"), budget.largest("measured", "settings")
    told = [] if seen is None else [f"the largest is {seen.cause}: {_mend(seen, budget)}"]
    if seen is not all_ and all_ is not None:
        told = [f"of the measured causes {one}" for one in told]
        told.insert(0, f"[odometry] declares {all_.cause} the largest: {_mend(all_, budget)}")
    if any(one.cause == "parameters" and one.basis == "unknown" for one in budget.shares):
        told.insert(0, CALIBRATE)
    return "; ".join(told) or "nothing here makes odometry wrong"


def _driven(budget: Budget) -> str:
    missing = f" ({budget.missing} missing)" if budget.missing else ""
    return (
        f"{budget.seconds:.1f} s, {budget.metres:.2f} m, {budget.turned:.0f} deg turned, "
        f"{budget.lines} lines{missing}; heading from the "
        f"{'gyro' if budget.gyro else 'wheels'}. If the drive goes on like this, each cause "
        "alone makes:"
    )


def _table(budget: Budget) -> Table:
    known = [(s.cause, s.mm_per_100_m, s.deg_per_turn, MEANING[s.cause], TOLD[s.basis])
             for s in budget.shares]  # fmt: skip
    total = ("all", *budget.total(), "root of the sum of their squares", "")
    rows = [
        (name, _number(mm, 0), _number(deg, 2), *told) for name, mm, deg, *told in [*known, total]
    ]
    return table(rows, ("", "mm in 100 m", "deg a turn", "", "based on"), right={1, 2})


def _track(budget: Budget, learned: float) -> str:
    implied = f"{learned:.3f} (standard deviation {budget.learned_std:.3f})"
    if budget.learned_used:
        return (
            f"By the gyro drive.wheel_separation_multiplier is {implied}. This value is used "
            "while only the wheels measure the turn; the configured value is "
            f"{budget.multiplier:.3f}."
        )
    return (
        f"By the gyro drive.wheel_separation_multiplier would be {implied}; the configured "
        f"value, which is used, is {budget.multiplier:.3f}. If both differ on the ground that "
        "matters, `acsard calibrate` measures it; [odometry] learned_track uses the learned "
        "value while the gyro is silent."
    )


def _standing(budget: Budget) -> str:
    along, turning = budget.at_rest
    counts = budget.counts
    return (
        f"the robot stands still ({budget.lines} lines in {budget.seconds:.1f} s), so errors of "
        "driving cannot be measured. By the settings, two decimals of rad/s leave each line "
        f"uncertain by {1e3 * along:.2f} mm/s and {1e3 * turning:.1f} mrad/s, "
        + (f"the encoders have {counts} counts" if counts else "the encoders' counts are not known")
        + f"; {_declared(budget)}"
    )


def _declared(budget: Budget) -> str:
    known = {share.cause: share for share in budget.shares}
    share = known.get("parameters")
    if share is None or share.basis == "unknown":
        return "radii and track were never calibrated"
    return (
        f"radii and track are known to {_number(share.mm_per_100_m, 0)} mm in 100 m straight on "
        f"and {_number(share.deg_per_turn, 2)} deg a turn"
    )


def _number(value: float | None, digits: int) -> str:
    if value is None:
        return "-"
    return (
        f"{value:.{digits}f}" if value >= 10.0**-digits or value == 0.0 else f"<{10.0**-digits:g}"
    )


def _mend(share: Share, budget: Budget) -> str:
    if share.cause != "quantisation":
        return MENDS[share.cause].format(
            late=1e3 * budget.lateness, missing=budget.missing, unseen=budget.unseen
        )
    if 0 < budget.counts <= COARSE_COUNTS:
        return (
            f"the encoders have {budget.counts} counts a turn: use finer ones, on the motor's shaft"
        )
    return "a plain line has only two decimals: let the lines carry counts (mcu.link_check)"
