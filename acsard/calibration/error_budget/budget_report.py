"""An error budget as text: a table for people, and advice on the largest error."""

from __future__ import annotations

from collections.abc import Iterator

from rich.console import RenderableType
from rich.table import Table

from acsard.calibration.error_budget.budget import Basis, Budget, Cause, Share
from acsard.core.motion.uncertainty import COARSE_COUNTS
from acsard.terminal.tables import table

MEANING: dict[Cause, str] = {
    "time": "when each line was made",
    "quantisation": "what a line rounds away",
    "gaps": "driven while no lines came",
    "slip": "wheels that skid",
    "parameters": "wheel radii and track",
    "gyro": "bias, noise and scale of the gyro",
}

MENDS: dict[Cause, str] = {
    "time": "lines are late by {late:.1f} ms: set the adapter's latency_timer to 1 (the udev rules "
    "do), or let the lines carry the microcontroller's clock and counts (mcu.link_check, "
    "mcu.encoder_counts)",
    "gaps": "{missing} lines did not come and {unseen:.2f} s of driving were not seen: look for a "
    "loose cable, noise on the wire or a busy machine (`acsard top`), or let the lines carry "
    "counts, which lose no way (mcu.link_check, mcu.encoder_counts)",
    "slip": "drive on other ground or turn less on the spot; a gyro sees what skidding wheels do "
    "not ([odometry] gyro)",
    "parameters": "run `acsard calibrate`: it measures wheel radii and effective track",
    "gyro": "let the robot stand for a second now and then, so that it learns the gyro's bias",
}  # fmt: skip

TOLD: dict[Basis, str] = {
    "measured": "what came",
    "settings": "[odometry]",
    "unknown": "nothing",
}

CALIBRATE = (
    "how wrong wheel radii and track are is not known, and on wheels that skid it is mostly the "
    "largest of all: run `acsard calibrate`"
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
        return "drive it, also around curves, while this looks: most causes show only then"
    seen, all_ = budget.largest("measured"), budget.largest("measured", "settings")
    told = [] if seen is None else [f"the largest is {seen.cause}: {_mend(seen, budget)}"]
    if seen is not all_ and all_ is not None:
        told = [f"of what was measured {one}" for one in told]
        told.insert(0, f"[odometry] declares {all_.cause} the largest: {_mend(all_, budget)}")
    if any(one.cause == "parameters" and one.basis == "unknown" for one in budget.shares):
        told.insert(0, CALIBRATE)
    return "; ".join(told) or "nothing here makes odometry wrong"


def _driven(budget: Budget) -> str:
    missing = f" ({budget.missing} missing)" if budget.missing else ""
    return (
        f"{budget.seconds:.1f} s, {budget.metres:.2f} m, {budget.turned:.0f} deg turned, "
        f"{budget.lines} lines{missing}; heading by the {'gyro' if budget.gyro else 'wheels'}. "
        "If it is driven on like this, each cause alone makes:"
    )


def _table(budget: Budget) -> Table:
    known = [(s.cause, s.mm_per_100_m, s.deg_per_turn, MEANING[s.cause], TOLD[s.basis])
             for s in budget.shares]  # fmt: skip
    total = ("all", *budget.total(), "the root of their squares", "")
    rows = [
        (name, _number(mm, 0), _number(deg, 2), *told) for name, mm, deg, *told in [*known, total]
    ]
    return table(rows, ("", "mm in 100 m", "deg a turn", "", "told by"), right={1, 2})


def _track(budget: Budget, learned: float) -> str:
    implied = f"{learned:.3f} (standard deviation {budget.learned_std:.3f})"
    if budget.learned_used:
        return (
            f"By the gyro drive.wheel_separation_multiplier is {implied}, which is in use where "
            f"the wheels alone tell the turn; configured is {budget.multiplier:.3f}."
        )
    return (
        f"By the gyro drive.wheel_separation_multiplier would be {implied}; configured, and in "
        f"use, is {budget.multiplier:.3f}. Where both differ on the ground that matters, `acsard "
        "calibrate` measures it; [odometry] learned_track uses what is learned while the gyro is "
        "silent."
    )


def _standing(budget: Budget) -> str:
    along, turning = budget.at_rest
    counts = budget.counts
    return (
        f"it stands still ({budget.lines} lines in {budget.seconds:.1f} s): of errors of driving "
        "nothing can be seen. By the settings two decimals of rad/s leave each line uncertain by "
        f"{1e3 * along:.2f} mm/s and {1e3 * turning:.1f} mrad/s, "
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
        return f"the encoders have {budget.counts} counts a turn: finer ones, on the motor's shaft"
    return "two decimals are all a plain line has: let the lines carry counts (mcu.link_check)"
