"""Access to the machine: clock, timers, threads, scheduling, processes, systemd, journal and
logs.
"""
