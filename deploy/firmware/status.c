#include "status.h"

#include "config.h"
#include "put.h"

#define CONTACTS_MS 100
#define VALUES_MS 1000

/* A fault of a driver is reported so soon after its begin, also if it is over by then. A press that cuts
 * the drivers' supply has this time to become known first. */
#define FAULT_MS 100

#define ESTOP_BIT (ESTOP_INPUT ? 0x01 : 0)
#define BUMPER_BITS (((1 << (BUMPER_INPUTS)) - 1) << 1)
#define DRIVER_BIT (DRIVER_INPUT ? 0x20 : 0)
#define SENT_BITS (ESTOP_BIT | BUMPER_BITS)
#define HAS_VALUES (DRIVER_INPUT || HAS_ANALOGS)

/* The pin of a pressed contact is high, but for these. */
#define LOW_BITS ((BUMPERS_CLOSE ? BUMPER_BITS : 0) | (DRIVER_FAULT_HIGH ? 0 : DRIVER_BIT))

/* V of the battery, and A, for one mV at the pin. */
#define VOLTS_PER_MV ((float)((BATTERY_TOP_OHM) + (BATTERY_BOTTOM_OHM)) / (BATTERY_BOTTOM_OHM) / 1000.0f)
#define AMPS_PER_MV (1000.0f / (CURRENT_UV_PER_A ? CURRENT_UV_PER_A : 1))

void status_start(struct status *status)
{
    const struct status nothing = {.sent = -1};

    *status = nothing;
}

void status_contacts(struct status *status, uint8_t levels)
{
    struct contact *contact = status->contacts;
    uint8_t bit = 1;

    levels ^= LOW_BITS;
    for (; contact < status->contacts + CONTACTS; contact++, bit = (uint8_t)(bit << 1)) {
        if (levels & bit) {
            contact->free = 0;
            if (contact->pressed < PRESS_SAMPLES && ++contact->pressed == PRESS_SAMPLES) {
                status->known |= bit;
                status->pressed |= bit;
                if (bit == DRIVER_BIT && !status->fault_ms)
                    status->fault_ms = 1;
            }
        } else if (contact->free < FREE_SAMPLES && ++contact->free == FREE_SAMPLES) {
            status->known |= bit;
            status->pressed &= (uint8_t)~bit;
            contact->pressed = 0;
        }
    }
    if (DRIVER_INPUT && status->fault_ms && status->fault_ms < FAULT_MS)
        status->fault_ms++;
}

void status_reading(struct status *status, uint8_t analog, uint16_t value)
{
    if (status->analogs[analog].readings == UINT16_MAX)
        return; /* for two minutes replies have left no room for a line */
    status->analogs[analog].sum += value;
    status->analogs[analog].readings++;
}

bool status_stopped(const struct status *status)
{
    return status->pressed & ESTOP_BIT;
}

/* Has a contact changed since it was sent? The first line waits until all of them are known. */
static bool contacts_changed(const struct status *status)
{
    return SENT_BITS && (status->known & SENT_BITS) == SENT_BITS &&
           (status->pressed & SENT_BITS) != status->sent;
}

/* The mean of the readings in mV at the pin; the next mean is of later ones. In the second between two
 * lines there are hundreds. */
static float mean_mv(struct status *status, uint8_t analog)
{
    float mean = (float)status->analogs[analog].sum / (float)status->analogs[analog].readings;

    status->analogs[analog].sum = 0;
    status->analogs[analog].readings = 0;
    return mean * ((REFERENCE_MV) / 1024.0f);
}

static char *put_hundredths(char *at, float value, uint32_t most)
{
    uint32_t size = (uint32_t)((value < 0.0f ? -value : value) * 100.0f + 0.5f);

    if (size > most)
        size = most;
    if (value < 0.0f && size)
        *at++ = '-';
    at = put_decimal(at, size / 100);
    *at++ = '.';
    *at++ = (char)('0' + size / 10 % 10);
    *at++ = (char)('0' + size % 10);
    return at;
}

static char *put_contacts(char *at, uint8_t pressed)
{
    uint8_t i;

    if (ESTOP_INPUT)
        at = put_text(at, pressed & ESTOP_BIT ? " estop=pressed" : " estop=ok");
    if (BUMPER_INPUTS)
        at = put_text(at, " bumpers=");
    for (i = 1; i <= BUMPER_INPUTS; i++)
        *at++ = pressed >> i & 1 ? 'X' : '.';
    return at;
}

static char *put_values(char *at, struct status *status)
{
    if (DRIVER_INPUT) {
        bool fault = status->fault_ms || status->pressed & DRIVER_BIT;

        at = put_text(at, fault ? " driver=fault" : " driver=ok");
        status->fault_ms = 0;
    }
    if (BATTERY_TOP_OHM)
        at = put_hundredths(put_text(at, " volts="), mean_mv(status, 0) * VOLTS_PER_MV, 9999);
    if (CURRENT_UV_PER_A)
        at = put_hundredths(put_text(at, " amps="),
                            (mean_mv(status, 1) - (CURRENT_ZERO_MV)) * AMPS_PER_MV, 99999);
    return at;
}

uint8_t status_line(struct status *status, uint32_t now_ms, char *out)
{
    char *at = put_text(out, "!status");
    bool changed = contacts_changed(status);
    bool values = HAS_VALUES && (now_ms - status->values_ms >= VALUES_MS ||
                                 (DRIVER_INPUT && status->fault_ms == FAULT_MS));

    /* A change is first, so that a press is known before the fault of a driver that lost its supply.
     * Else the values are: on a wire that replies fill, the contacts would leave them no room. */
    if (!changed && values) {
        status->values_ms = now_ms;
        at = put_values(at, status);
    } else if (changed || (status->sent >= 0 && now_ms - status->contacts_ms >= CONTACTS_MS)) {
        status->contacts_ms = now_ms;
        status->sent = status->pressed & SENT_BITS;
        at = put_contacts(at, status->pressed);
    } else {
        return 0;
    }
    *at++ = '*';
    at = put_hex(at, crc_of(out, (uint8_t)(at - 1 - out)), 4);
    at = put_text(at, "\r\n");
    return (uint8_t)(at - out);
}
