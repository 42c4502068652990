#include "line.h"

#include "config.h"
#include "crc.h"
#include "put.h"

void count_up(uint16_t *counter)
{
    if (*counter < UINT16_MAX)
        ++*counter;
}

uint8_t line_feed(struct line_reader *reader, uint8_t byte)
{
    uint8_t length = reader->length;

    if (byte != '\n') {
        /* Noise without a line end: forget it all, up to the next line end. */
        if (length >= LINE_MAX - 1)
            reader->discarding = true;
        else
            reader->text[reader->length++] = (char)byte;
        return 0;
    }
    reader->length = 0;
    if (reader->discarding) {
        reader->discarding = false;
        count_up(&reader->too_long);
        return 0;
    }
    if (length && reader->text[length - 1] == '\r')
        length--;
    return length;
}

struct cursor {
    const char *at;
    const char *end;
};

static bool take(struct cursor *cursor, char wanted)
{
    if (cursor->at == cursor->end || *cursor->at != wanted)
        return false;
    cursor->at++;
    return true;
}

static bool is_digit(const struct cursor *cursor)
{
    return cursor->at != cursor->end && *cursor->at >= '0' && *cursor->at <= '9';
}

/* Two digits, a point, two decimals, as the host writes them: were one decimal enough, a line that
 * was cut before its last digit would still be one. */
static bool take_number(struct cursor *cursor, int16_t *hundredths)
{
    int16_t value = 0;
    uint8_t place;

    for (place = 0; place < 5; place++) {
        if (place == 2) {
            if (!take(cursor, '.'))
                return false;
            continue;
        }
        if (!is_digit(cursor))
            return false;
        value = (int16_t)(value * 10 + (*cursor->at++ - '0'));
    }
    *hundredths = value;
    return true;
}

static bool take_wheel(struct cursor *cursor, struct command *command, uint8_t *seen)
{
    uint8_t motor, bit;
    int16_t value;
    bool negative;

    if (cursor->at == cursor->end || *cursor->at < 'a' || *cursor->at > 'd')
        return false;
    motor = (uint8_t)(*cursor->at++ - 'a');
    bit = (uint8_t)(1u << motor);
    if (*seen & bit)
        return false;
    *seen |= bit;
    negative = take(cursor, 'n');
    if (!negative && !take(cursor, 'p'))
        return false;
    if (!take_number(cursor, &value))
        return false;
    command->hundredths[motor] = (int16_t)(negative ? -value : value);
    return true;
}

static bool take_comma(struct cursor *cursor)
{
    if (!take(cursor, ','))
        return false;
    while (take(cursor, ' '))
        ;
    return true;
}

static bool take_hex(struct cursor *cursor, uint8_t digits, uint16_t *value)
{
    *value = 0;
    while (digits--) {
        char c = cursor->at == cursor->end ? '\0' : *cursor->at++;

        if (c >= '0' && c <= '9')
            *value = (uint16_t)(*value << 4 | (c - '0'));
        else if (c >= 'A' && c <= 'F')
            *value = (uint16_t)(*value << 4 | (c - 'A' + 10));
        else
            return false;
    }
    return true;
}

/* `#SS`, request letters, `*HHHH` over all before it. Letters that mean nothing to us are ignored,
 * so that a newer host may ask for more. */
static bool take_suffix(struct cursor *cursor, const char *text, struct command *command)
{
    uint16_t sequence, said, right;

    if (!take(cursor, '#') || !take_hex(cursor, 2, &sequence))
        return false;
    while (cursor->at != cursor->end && *cursor->at >= 'G' && *cursor->at <= 'Z')
        command->sample |= *cursor->at++ == 'S';
    right = crc_of(text, (uint8_t)(cursor->at - text));
    if (!take(cursor, '*') || !take_hex(cursor, 4, &said) || said != right)
        return false;
    command->checked = true;
    command->sequence = (uint8_t)sequence;
    return true;
}

bool line_parse(const char *text, uint8_t length, struct command *out)
{
    struct cursor cursor = {text, text + length};
    struct command command = {{0, 0, 0, 0}, false, false, 0};
    uint8_t seen = 0, motor;

    for (motor = 0; motor < 4; motor++) {
        if (motor && !take_comma(&cursor))
            return false;
        if (!take_wheel(&cursor, &command, &seen))
            return false;
    }
    (void)take_comma(&cursor);
    if (cursor.at != cursor.end && !take_suffix(&cursor, text, &command))
        return false;
    if (cursor.at != cursor.end)
        return false;
    *out = command;
    return true;
}

bool line_asks(const char *text, uint8_t length)
{
    return length == 1 && text[0] == '?';
}

static char *put_speed(char *at, char letter, int16_t hundredths)
{
    uint16_t value = (uint16_t)(hundredths < 0 ? -hundredths : hundredths);
    uint8_t whole = (uint8_t)(value / 100), part = (uint8_t)(value % 100);

    *at++ = letter;
    *at++ = hundredths < 0 ? 'n' : 'p';
    *at++ = (char)('0' + whole / 10);
    *at++ = (char)('0' + whole % 10);
    *at++ = '.';
    *at++ = (char)('0' + part / 10);
    *at++ = (char)('0' + part % 10);
    return at;
}

uint8_t line_reply(char *out, const struct command *command, const struct reading *reading)
{
    char *at = out;
    uint8_t motor;

    for (motor = 0; motor < 4; motor++) {
        if (motor)
            *at++ = ',';
        at = put_speed(at, LETTERS[motor], reading->hundredths[motor]);
    }
    if (command->checked) {
        uint16_t crc;

        *at++ = '#';
        at = put_hex(at, command->sequence, 2);
        if (command->sample) {
            *at++ = '@';
            at = put_hex(at, reading->milliseconds, 4);
            for (motor = 0; motor < 4; motor++)
                at = put_hex(at, reading->counts[motor], 4);
        }
        crc = crc_of(out, (uint8_t)(at - out));
        *at++ = '*';
        at = put_hex(at, crc, 4);
    }
    *at++ = '\r';
    *at++ = '\n';
    return (uint8_t)(at - out);
}

static char *put_at_most(char *at, uint16_t value, uint16_t most)
{
    return put_decimal(at, value < most ? value : most);
}

uint8_t line_identity(char *out, const struct record *record, const char *reset)
{
    char *at = put_text(out, "!acsard-mcu 1");

    at = put_decimal(put_text(at, " counts="), (uint32_t)(COUNTS_PER_TURN));
    at = put_decimal(put_text(at, " watchdog_ms="), COMMAND_WATCHDOG_MS);
    at = put_text(at, " check=1 sample=1");
    at = put_decimal(put_text(at, " lines="), record->lines);
    at = put_at_most(put_text(at, " refused="), record->refused, 999);
    at = put_at_most(put_text(at, " trips="), record->trips, 999);
    at = put_at_most(put_text(at, " runaways="), record->runaways, 9);
    at = put_text(put_text(put_text(at, " reset="), reset), "\r\n");
    return (uint8_t)(at - out);
}
