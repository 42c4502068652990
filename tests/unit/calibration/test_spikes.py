"""Cells that cannot be a measurement are removed, and real turns are kept."""

from __future__ import annotations

import numpy as np
import pytest

from acsard.calibration.spikes import Floats, bounded


def table(count: int = 200) -> dict[str, Floats]:
    turned = np.arange(count) % 10.0
    return {
        "t": np.arange(count) / 10,
        "left": turned.copy(),
        "right": turned.copy(),
        "yaw_rate": np.full(count, 0.1),
    }


def test_a_spike_counts_as_missing_and_a_fast_drive_does_not() -> None:
    columns = table()
    columns["left"][70], columns["yaw_rate"][70] = 900.0, -40.0
    notes = list(bounded(columns))
    assert np.flatnonzero(np.isnan(columns["left"])).tolist() == [70]
    assert np.flatnonzero(np.isnan(columns["yaw_rate"])).tolist() == [70]
    assert not np.isnan(columns["right"]).any()
    assert notes == [
        "1 cell of left left out as impossible, like 900",
        "1 cell of yaw_rate left out as impossible, like -40",
    ]


def test_a_spike_is_found_between_rows_of_other_sensors() -> None:
    columns = table()
    columns["yaw_rate"][1::2] = np.nan
    columns["yaw_rate"][100] = 40.0
    assert list(bounded(columns)) == ["1 cell of yaw_rate left out as impossible, like 40"]


def mostly_standing(rng: np.random.Generator) -> dict[str, Floats]:
    """Return half an hour at 100 Hz in which the robot turns for 20 s."""
    t = np.arange(180_000) / 100
    rate = np.where((t > 900) & (t < 920), 1.0, 0.0) + 0.03 + rng.normal(0, 0.003, len(t))
    wheels = np.where((t > 900) & (t < 920), 4.8, 0.0)
    return {"t": t, "left": -wheels, "right": wheels, "yaw_rate": rate}


@pytest.mark.parametrize("order", ["as recorded", "shuffled", "beside another drive"])
def test_the_turns_of_who_mostly_stands_are_no_spikes(order: str) -> None:
    rng = np.random.default_rng(1)
    columns = mostly_standing(rng)
    if order == "shuffled":
        mixed = rng.permutation(len(columns["t"]))
        columns = {name: values[mixed] for name, values in columns.items()}
    elif order == "beside another drive":
        other = columns | {"yaw_rate": rng.normal(0.03, 0.003, len(columns["t"]))}
        columns = {name: np.concatenate([columns[name], other[name]]) for name in columns}
    assert list(bounded(columns)) == []


def test_what_is_beyond_all_bounds_is_none_however_long() -> None:
    columns = table()
    columns["left"][50:60], columns["t"][3] = np.inf, 1e21
    assert len(list(bounded(columns))) == 2
    assert np.isnan(columns["left"][50:60]).all()
