"""Access to the machine: clock, threads, scheduling, processes, systemd, files and logs."""
