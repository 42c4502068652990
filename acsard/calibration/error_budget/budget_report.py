"""Prints an error budget: a table of the causes, and advice on the largest one."""

from __future__ import annotations

from collections.abc import Iterator

from rich.console import RenderableType
from rich.table import Table

from acsard.calibration.error_budget.budget import Basis, Budget, Cause, Share
from acsard.core.motion.uncertainty import ASSUMED_COUNTS
from acsard.terminal.output import table

CAUSE_TEXTS: dict[Cause, str] = {
    "time": "errors in the times of feedback lines",
    "quantization": "rounding of the values in a feedback line",
    "gaps": "distance driven while no feedback lines arrived",
    "slip": "wheels that skid",
    "parameters": "wheel radii and track",
    "gyro": "bias, noise and scale of the gyro",
}

ADVICE: dict[Cause, str] = {
    "time": "the times of feedback lines are wrong by {late:.1f} ms: either set the latency_timer "
    "of the serial adapter to 1 (acsard's udev rules do that), or set mcu.link_check and "
    "mcu.encoder_counts, so that the microcontroller adds its clock and encoder counts to the "
    "feedback lines",
    "gaps": "{missing} feedback lines were lost, so {unseen:.2f} s of driving were not measured: "
    "look for a loose cable, noise on the wire or a busy machine (`acsard top`); if the feedback "
    "lines carry encoder counts, a lost line loses no distance (mcu.link_check, "
    "mcu.encoder_counts)",
    "slip": "drive on other ground, turn less on the spot, or use a gyro ([odometry] gyro), which "
    "measures turns that skidding wheels do not show",
    "parameters": "run `acsard calibrate`: it measures wheel radii and effective track",
    "gyro": "let the robot stand still for a second now and then, so that the daemon learns the "
    "bias of the gyro",
}

BASIS_TEXTS: dict[Basis, str] = {
    "measured": "measurements",
    "settings": "[odometry]",
    "unknown": "nothing",
}


def parts(budget: Budget) -> Iterator[RenderableType]:
    """Yield the parts of the printed report: sentences, and a table of the causes."""
    if budget.still:
        yield _standing(budget)
    else:
        yield from (_driven(budget), "", _table(budget))
    if budget.learned is not None:
        yield from ("", _track(budget, budget.learned))
    sentence = advice(budget)
    yield from ("", f"{sentence[0].upper()}{sentence[1:]}.")


def advice(budget: Budget) -> str:
    """Return advice on the largest measured cause of errors.

    If the settings of `[odometry]` state a larger error of another cause, the text also contains
    advice on that cause.
    """
    if budget.still:
        return (
            "drive the robot, also around curves, while the tool measures: a robot that stands "
            "does not show most causes of errors"
        )
    measured, largest = budget.largest("measured"), budget.largest("measured", "settings")
    advice = []
    if budget.coarse:
        advice.append(
            "the encoders are coarse and the daemon does not know how many counts they have per "
            "wheel turn, so an error in the time of a feedback line becomes an error of the "
            "heading: write the counts per wheel turn as mcu.encoder_counts (`acsard mcu check` "
            "estimates them)"
        )
    if any(share.cause == "parameters" and share.basis == "unknown" for share in budget.shares):
        advice.append(
            "the errors of the configured wheel radii and track width are unknown, and if the "
            "wheels skid, they are usually the largest errors: run `acsard calibrate`"
        )
    if largest is not None and largest is not measured:
        advice.append(
            "according to the settings in [odometry], the largest cause of errors is "
            f"{largest.cause}: {_advice_on(largest, budget)}"
        )
    if measured is not None:
        advice.append(
            f"the largest measured cause of errors is {measured.cause}: "
            f"{_advice_on(measured, budget)}"
        )
    return "; ".join(advice) or "no cause of errors was measured on this drive"


def _driven(budget: Budget) -> str:
    missing = f" ({budget.missing} missing)" if budget.missing else ""
    return (
        f"{budget.seconds:.1f} s, {budget.metres:.2f} m, {budget.turned:.0f} deg turned, "
        f"{budget.lines} feedback lines{missing}; heading from the "
        f"{'gyro' if budget.gyro else 'wheels'}. If the drive continues like this, each cause "
        "alone makes this error:"
    )


def _table(budget: Budget) -> Table:
    causes = [(s.cause, s.mm_per_100_m, s.deg_per_turn, CAUSE_TEXTS[s.cause], BASIS_TEXTS[s.basis])
              for s in budget.shares]  # fmt: skip
    total = ("all", *budget.total(), "square root of the sum of the squares above", "")
    rows = [
        (name, _number(mm, 0), _number(deg, 2), *words)
        for name, mm, deg, *words in [*causes, total]
    ]
    return table(rows, ("", "mm in 100 m", "deg per turn", "", "based on"), right={1, 2})


def _track(budget: Budget, learned: float) -> str:
    implied = (
        f"According to the gyro, drive.wheel_separation_multiplier should be {learned:.3f} "
        f"(standard deviation {budget.learned_std:.3f})."
    )
    if budget.learned_used:
        return (
            f"{implied} Odometry uses this value while no gyro messages arrive; the configured "
            f"value is {budget.multiplier:.3f}."
        )
    return (
        f"{implied} Odometry uses the configured value, {budget.multiplier:.3f}. If the two values "
        "differ on the ground where the robot works, either run `acsard calibrate`, or set "
        "[odometry] learned_track = true: odometry then uses the value that it learned from the "
        "gyro while no gyro messages arrive."
    )


def _standing(budget: Budget) -> str:
    along, turning = budget.at_rest
    counts = budget.counts
    return (
        f"the robot stands still ({budget.lines} feedback lines in {budget.seconds:.1f} s), so "
        "errors of driving cannot be measured. Wheel speeds with two decimals (rad/s) leave the "
        f"twist uncertain by {1e3 * along:.2f} mm/s and {1e3 * turning:.1f} mrad/s; "
        + (
            f"the encoders have {counts} counts per wheel turn"
            if counts
            else "the daemon does not know the encoder counts per wheel turn"
        )
        + f"; {_declared(budget)}"
    )


def _declared(budget: Budget) -> str:
    known = {share.cause: share for share in budget.shares}
    share = known.get("parameters")
    if share is None or share.basis == "unknown":
        return "wheel radii and track were never calibrated"
    return (
        "the uncertainty of wheel radii and track causes an error of "
        f"{_number(share.mm_per_100_m, 0)} mm in 100 m straight ahead and "
        f"{_number(share.deg_per_turn, 2)} deg in a full turn of the robot"
    )


def _number(value: float | None, digits: int) -> str:
    if value is None:
        return "-"
    return (
        f"{value:.{digits}f}" if value >= 10.0**-digits or value == 0.0 else f"<{10.0**-digits:g}"
    )


def _advice_on(share: Share, budget: Budget) -> str:
    if share.cause != "quantization":
        return ADVICE[share.cause].format(
            late=1e3 * budget.lateness, missing=budget.missing, unseen=budget.unseen
        )
    if 0 < budget.counts <= ASSUMED_COUNTS:
        return (
            f"the encoders have only {budget.counts} counts per wheel turn: use encoders with more "
            "counts, on the shafts of the motors"
        )
    return (
        'the speeds in a plain feedback line have only two decimals: set mcu.link_check = "auto" '
        "and mcu.encoder_counts, so that the microcontroller adds encoder counts to its lines"
    )
