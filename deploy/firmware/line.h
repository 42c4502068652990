/* Serial lines: bytes -> line -> command, and reading -> reply. Knows nothing of the hardware.
 *
 * All or nothing: what is not a whole valid line changes nothing.
 */
#ifndef LINE_H
#define LINE_H

#include <stdbool.h>
#include <stdint.h>

#define LINE_MAX 128  /* bytes with the line end; the longest line is under 70, more is noise */
#define REPLY_MAX 64  /* bytes of the longest reply with CR LF: 62 */
#define IDENTITY_MAX 128 /* the host takes no longer line; with all counters full it has 126 */
#define LETTERS "abcd"

struct line_reader {
    char text[LINE_MAX];
    uint8_t length;
    bool discarding;
    uint16_t too_long; /* lines thrown away whole, up to 65535 */
};

/* Takes a byte. Returns the length of the line it completes, whose text (without its end) stays in
 * `reader->text` until the next call; 0 when it completes none. Empty lines are none. */
uint8_t line_feed(struct line_reader *reader, uint8_t byte);

struct command {
    int16_t hundredths[4]; /* of a rad/s, motors a to d */
    bool checked;           /* it had a right suffix, so it is answered with one */
    bool sample;            /* ... which asks for the sample fields */
    uint8_t sequence;
};

/* True and `*out` set when the line is a valid command; else false and `*out` untouched. */
bool line_parse(const char *text, uint8_t length, struct command *out);

/* True when the line asks who we are. */
bool line_asks(const char *text, uint8_t length);

struct reading {
    uint16_t milliseconds;  /* when the encoders were read */
    uint16_t counts[4];
    int16_t hundredths[4];  /* of a rad/s; within +-9999 */
};

/* Writes the answer to `command` with CR LF, no terminator; returns its length, at most REPLY_MAX. */
uint8_t line_reply(char *out, const struct command *command, const struct reading *reading);

/* What became of the lines since boot, and of the wheels. */
struct record {
    uint32_t lines;    /* commands executed; begins again after 2^32: 497 days at 100 Hz */
    uint16_t refused;  /* lines that are neither a command taken nor a question; up to 65535 */
    uint16_t trips;    /* silences that cut motors which had voltage; up to 65535 */
    uint16_t runaways; /* how often a wheel that did not do as told has cut them; up to 65535 */
};

/* Adds one, but stays at the largest: a counter that wrapped would say that all is well. */
void count_up(uint16_t *counter);

/* Writes who we are, our record and why we were reset with CR LF; returns its length. For want of room
 * `refused` and `trips` say 999 for more than that, and `runaways` 9. */
uint8_t line_identity(char *out, const struct record *record, const char *reset);

#endif
