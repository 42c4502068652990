"""A device whose driver hangs in `open` blocks one thread, and the daemon opens the next device."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.system.harness import Bus, Daemon, Peer, environment, until

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(shutil.which("gcc") is None, reason="needs gcc"),
]

HANGS = """\
#define _GNU_SOURCE
#include <dlfcn.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

static int opened(const char *by, const char *path, int flags, int mode)
{
    char *there = realpath(path, NULL);
    if (there != NULL && strcmp(there, getenv("HANGS")) == 0) {
        FILE *book = fopen(getenv("BOOK"), "a");
        fputs(".", book);
        fclose(book);
        for (;;)
            pause();
    }
    free(there);
    return ((int (*)(const char *, int, ...))dlsym(RTLD_NEXT, by))(path, flags, mode);
}

int open(const char *path, int flags, int mode)
{
    return opened("open", path, flags, mode);
}

int open64(const char *path, int flags, int mode)
{
    return opened("open64", path, flags, mode);
}
"""
"""Opening the device $HANGS never ends, and leaves a dot in the file $BOOK."""

TRIES = 20
"""Number of states, ten a second: two seconds in which the device would have been tried again."""


def test_a_driver_that_hangs_is_tried_once_and_another_device_is_opened(tmp_path: Path) -> None:
    source, library, book = (tmp_path / name for name in ("hangs.c", "hangs.so", "book"))
    source.write_text(HANGS)
    subprocess.run(["gcc", "-shared", "-fPIC", "-o", str(library), str(source), "-ldl"], check=True)
    port, other = tmp_path / "port", tmp_path / "other"
    master, slave = os.openpty()
    device = os.ttyname(slave)
    port.symlink_to(device)
    env = environment(LD_PRELOAD=str(library), HANGS=device, BOOK=str(book))
    try:
        with (
            Daemon(tmp_path, port, env=env) as daemon,
            Bus(daemon.endpoint) as bus,
            bus.follow("state") as states,
        ):
            until(lambda: daemon.events("port_waiting"), 10.0, "the driver does not answer")
            count = len(states.seen)
            until(lambda: len(states.seen) >= count + TRIES, 10.0, "some more states")
            assert book.read_text() == "."
            with Peer(other):
                port.unlink()
                port.symlink_to(os.readlink(other))
                bus.linked()
    finally:
        os.close(master)
        os.close(slave)
