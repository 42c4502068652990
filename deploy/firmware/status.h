/* The inputs of the board, and the status lines that report them beside the replies. Pure logic.
 *
 * Two kinds of line share the wire: the emergency stop and the bumpers ten times a second, and at once
 * when one changes; the drivers' fault and the measured values once a second, and soon after a fault
 * has begun.
 */
#ifndef STATUS_H
#define STATUS_H

#include <stdbool.h>
#include <stdint.h>

#define STATUS_MAX 64 /* bytes of the longest line with CR LF: 52 */
#define CONTACTS 6    /* bits of their port: 0 emergency stop, 1 to 4 bumpers, 5 driver fault */
#define ANALOGS 2     /* 0 battery, 1 current */

/* Number of samples that change a contact. Three pressed samples make it count as pressed. Only 20 free
 * samples in a row release it, and only after them the next press needs three samples again. So a
 * bouncing contact or a loose wire counts as pressed, and a single disturbance does not. */
#define PRESS_SAMPLES 3
#define FREE_SAMPLES 20

struct contact {
    uint8_t pressed, free; /* samples, at most the numbers above */
};

struct status {
    struct contact contacts[CONTACTS];
    uint8_t known, pressed; /* a bit for each contact */
    struct {
        uint32_t sum; /* of the readings since the last line with their mean */
        uint16_t readings;
    } analogs[ANALOGS];
    uint32_t contacts_ms, values_ms; /* when each line was sent last */
    int16_t sent;                    /* the emergency stop and the bumpers in the last one; -1: none yet */
    uint8_t fault_ms;                /* since a fault of a driver began that no line has reported; 0: none */
};

/* Sets the state after boot: the inputs are unknown. */
void status_start(struct status *status);

/* A sample of all contacts: the levels of their pins, 1 is high. Call it once a millisecond. */
void status_contacts(struct status *status, uint8_t levels);

/* A reading of an analog input, 0 to 1023. */
void status_reading(struct status *status, uint8_t analog, uint16_t value);

/* Returns whether the emergency stop is pressed; false until it is known, 20 ms after boot. */
bool status_stopped(const struct status *status);

/* Writes the status line that is due, with CR LF and without a terminator, and counts it as sent. Returns
 * its length, at most STATUS_MAX, or 0 if none is due. */
uint8_t status_line(struct status *status, uint32_t now_ms, char *out);

#endif
