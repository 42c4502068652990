"""The package of `acsard bench`, which measures a daemon from outside its process.

All processes of the benchmark read the same monotonic clock, so their times can be compared.
"""
