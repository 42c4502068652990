/* Serial lines: bytes become a line and a command, and a reading becomes a reply. Pure logic.
 *
 * A line counts as a whole or not at all: an invalid line changes nothing.
 */
#ifndef LINE_H
#define LINE_H

#include <stdbool.h>
#include <stdint.h>

#define LINE_MAX 128  /* bytes with the line end; the longest valid line has under 70 */
#define REPLY_MAX 64  /* bytes of the longest reply with CR LF: 62 */
#define IDENTITY_MAX 128 /* the host accepts no longer line; with full counters it has 126 */
#define LETTERS "abcd"

struct line_reader {
    char text[LINE_MAX];
    uint8_t length;
    bool discarding;
    uint16_t too_long; /* number of lines that were too long, up to 65535 */
};

/* Takes a byte. If it completes a line, returns the line's length; the text, without the line end, stays
 * in `reader->text` until the next call. Otherwise returns 0, also for an empty line. */
uint8_t line_feed(struct line_reader *reader, uint8_t byte);

struct command {
    int16_t hundredths[4]; /* of a rad/s, motors a to d */
    bool checked;           /* the line had a valid suffix, so the reply gets one too */
    bool sample;            /* the suffix asks for the sample fields */
    uint8_t sequence;
};

/* Returns true and sets `*out` if the line is a valid command; otherwise leaves `*out` as it is. */
bool line_parse(const char *text, uint8_t length, struct command *out);

/* Returns true if the line asks for the identification. */
bool line_asks(const char *text, uint8_t length);

struct reading {
    uint16_t milliseconds;  /* when the encoders were read */
    uint16_t counts[4];
    int16_t hundredths[4];  /* of a rad/s; within +-9999 */
};

/* Writes the answer to `command` with CR LF, no terminator; returns its length, at most REPLY_MAX. */
uint8_t line_reply(char *out, const struct command *command, const struct reading *reading);

/* Counters since boot. */
struct record {
    uint32_t lines;    /* executed commands; restarts at 0 after 2^32, which is 497 days at 100 Hz */
    uint16_t refused;  /* lines that are neither an executed command nor a question; up to 65535 */
    uint16_t trips;    /* silences of the host that stopped driven motors; up to 65535 */
    uint16_t runaways; /* times that a wheel which did not obey has stopped all motors; up to 65535 */
};

/* Adds one, except at the largest value: a counter that wraps to 0 would hide its events. */
void count_up(uint16_t *counter);

/* Writes the identification line with the counters, the cause of the last reset and CR LF. Returns its
 * length. The line has room for at most 999 in `refused` and `trips`, and for at most 9 in `runaways`. */
uint8_t line_identity(char *out, const struct record *record, const char *reset);

#endif
