from pathlib import Path

FORMAT_1 = Path(__file__).parent / "format_1.mcap"
"""A drive through a dozen faults, recorded when recordings were of format 1."""

FORMAT_1_SUM = 0x5D228EA7
"""Of all steps in it, as the code of then read them (`tests/unit/record/test_earlier.py`)."""
