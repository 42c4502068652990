/* The command watchdog: may the motors run? Pure logic; the time is an argument. */
#ifndef WATCHDOG_H
#define WATCHDOG_H

#include <stdbool.h>
#include <stdint.h>

struct watchdog {
    uint32_t fed_ms;
    bool fed; /* since boot, and not too long ago */
};

/* As after boot: the motors may not run. */
void watchdog_start(struct watchdog *watchdog);

/* A valid line came. */
void watchdog_feed(struct watchdog *watchdog, uint32_t now_ms);

/* Call it at least every few ms. Once false it stays false until fed, however far the clock wraps. */
bool watchdog_allows(struct watchdog *watchdog, uint32_t now_ms);

#endif
