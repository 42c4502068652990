#include "watchdog.h"

#include "config.h"

void watchdog_start(struct watchdog *watchdog)
{
    watchdog->fed_ms = 0;
    watchdog->fed = false;
}

void watchdog_feed(struct watchdog *watchdog, uint32_t now_ms)
{
    watchdog->fed_ms = now_ms;
    watchdog->fed = true;
}

bool watchdog_allows(struct watchdog *watchdog, uint32_t now_ms)
{
    if (now_ms - watchdog->fed_ms >= COMMAND_WATCHDOG_MS)
        watchdog->fed = false;
    return watchdog->fed;
}
