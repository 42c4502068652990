"""`acsard calibrate` without a log: what a person is told, what is driven, what is measured.

A way of calibrating is a generator (`gyro.py`, `tape.py` ...): it yields what to say, to ask and to
drive (`steps.py`) and is sent the answers, so that each reads from top to bottom as what happens.
One leg of a drive is `riding.py`: messages and keys in, commands out.
"""
