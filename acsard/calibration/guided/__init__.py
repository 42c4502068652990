"""`acsard calibrate` without a log: instructions, legs and measurements of a guided drive.

Each method of calibration is a generator (in `tour.py`, `tape.py`, `wall.py` and `umbmark.py`). It
yields the legs to drive and the numbers to ask for (`legs.py`) and is sent the answers, so that
its code reads from top to bottom in the order of events. `client/riding.py` drives one leg:
messages and keys go in, commands come out.
"""
