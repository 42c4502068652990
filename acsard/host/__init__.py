"""Shell: the machine beneath us: clock, timers, threads, scheduling, systemd, journal, logs."""
