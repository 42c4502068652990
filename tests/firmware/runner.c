/* A board on the bench: runs the firmware's machine code in libsimavr, behind a pty, with four motors.
 *
 * runner [--board mega-c|mega|uno] [--baud N] [--free-speed A,B,C,D] [--counts N] FIRMWARE.elf
 *
 * It is wired as the page howto/wire of the manual says, from numbers of its own: an error in the firmware's
 * pins is not repeated here. `mega-c` has the encoders where the C firmware needs them, `uno` is an
 * ATmega328P with two motors. Time is the wall clock's, in slices of half a millisecond; a machine too
 * slow for that is not caught up with for more than CATCH_UP_NS, the rest is skipped and counted.
 *
 * As root it takes precedence over all usual processes, because nothing that else runs on this machine
 * slows a real board down.
 *
 * The first line on standard output and the answer to each command on standard input is one JSON
 * object in a line. Commands (MOTOR is a to d):
 *
 *   status                       the true state of everything
 *   reset                        the reset pin
 *   pause, resume                virtual time stands still
 *   mute, unmute                 what the board says is lost
 *   drop to|from N               every Nth byte to or from the board is lost; 0 = none
 *   noise to|from N              one bit of every Nth byte is wrong; 0 = none
 *   lose to|from PERCENT         so many lines are lost whole, by chance; 0 = none
 *   type WORD                    a line to the board that the host has not sent
 *   unplug, plug                 the port vanishes; a new one appears
 *   encoder MOTOR ok|dead|swapped
 *   load MOTOR SHARE             the motor turns slower by this share; 1 = it is jammed
 *   contact PIN open|closed      what is between digital pin 30 to 37 and ground; open at first
 *   analog PIN MV                the voltage at analog pin 0 or 1
 *   bench MS                     that much virtual time as fast as it goes
 */
#define _GNU_SOURCE
#include <errno.h>
#include <fcntl.h>
#include <inttypes.h>
#include <math.h>
#include <poll.h>
#include <sched.h>
#include <stdarg.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

#include <avr_adc.h>
#include <avr_ioport.h>
#include <avr_uart.h>
#include <sim_avr.h>
#include <sim_elf.h>

#define F_CPU 16000000u
#define SLICE (F_CPU / 2000)
#define NS_PER_S 1000000000ll
#define CATCH_UP_NS (100 * 1000000ll)
#define MOTORS 4
#define QUEUE 16384

/* Registers of both chips, as data addresses (data sheets, register summary). */
enum {
    PINC = 0x26, DDRC = 0x27, PORTC = 0x28, PCIFR = 0x3B, PCICR = 0x68, PCMSK2 = 0x6D,
    TCCR1A = 0x80, TCCR1B = 0x81, ICR1 = 0x86, OCR1A = 0x88, TCCR2A = 0xB0, TCCR2B = 0xB1, OCR2A = 0xB3,
    TCCR3A = 0x90, TCCR3B = 0x91, ICR3 = 0x96, OCR3A = 0x98,
    TCCR4A = 0xA0, TCCR4B = 0xA1, ICR4 = 0xA6, OCR4A = 0xA8, OCR4B = 0xAA, OCR4C = 0xAC,
    UCSR0A = 0xC0, UBRR0 = 0xC4, MCUSR = 0x54
};
enum { PCINT2 = 11, EXTRF = 1 << 1 };

struct line {
    char port;
    uint8_t bit;
};

/* Where the PWM of each motor comes from, and the lines of its bridge and its encoder. */
static const struct board {
    const char *name, *chip;
    int motors;
    struct pwm {
        uint16_t control_a, control_b, top, compare;
        struct line line;
        uint8_t mode_shift, clock; /* of analogWrite: a 64th of the chip's */
    } pwm[MOTORS];
    struct line forward[MOTORS], reverse[MOTORS], a[MOTORS], b[MOTORS];
} BOARDS[] = {
#define MEGA                                                                                       \
    "atmega2560", 4,                                                                               \
    {{TCCR3A, TCCR3B, ICR3, OCR3A, {'E', 3}, 6, 3}, {TCCR4A, TCCR4B, ICR4, OCR4A, {'H', 3}, 6, 3},   \
     {TCCR4A, TCCR4B, ICR4, OCR4B, {'H', 4}, 4, 3}, {TCCR4A, TCCR4B, ICR4, OCR4C, {'H', 5}, 2, 3}}, \
    {{'A', 0}, {'A', 2}, {'A', 4}, {'A', 6}}, {{'A', 1}, {'A', 3}, {'A', 5}, {'A', 7}}
    {"mega-c", MEGA, {{'K', 0}, {'K', 2}, {'K', 4}, {'K', 6}}, {{'K', 1}, {'K', 3}, {'K', 5}, {'K', 7}}},
    {"mega", MEGA, {{'E', 4}, {'E', 5}, {'D', 3}, {'D', 2}}, {{'K', 1}, {'K', 3}, {'K', 5}, {'K', 7}}},
    {"uno", "atmega328p", 2,
     {{TCCR1A, TCCR1B, ICR1, OCR1A, {'B', 1}, 6, 3}, {TCCR2A, TCCR2B, 0, OCR2A, {'B', 3}, 6, 4}},
     {{'B', 4}, {'D', 7}}, {{'B', 5}, {'B', 0}}, {{'D', 3}, {'D', 2}}, {{'D', 5}, {'D', 4}}},
};
static const struct board *board = BOARDS;

static uint16_t pin_register(char port) /* its direction and its output are the next two */
{
    return (uint16_t)(port < 'H' ? 0x20 + 3 * (port - 'A') : 0x100 + 3 * (port - (port > 'I') - 'H'));
}

enum encoder { OK, DEAD, SWAPPED };

static struct motor {
    double free_speed, load;
    double duty;             /* -1 to 1, as the bridge gives it */
    uint8_t pins;            /* the bridge's inputs: 1 forward, 2 reverse */
    double speed;            /* rad/s */
    double position;         /* counts */
    int64_t counts;          /* whole ones, as the encoder has shown them */
    int64_t counts_at_reset; /* where the firmware began to count */
    avr_cycle_count_t at;    /* how far this is worked out */
    double flip_duty;        /* the highest duty at which the bridge ever changed direction */
    struct {
        bool counts;               /* the timer is in its PWM mode */
        avr_cycle_count_t started; /* since then, from zero */
        uint64_t tops;             /* so often it was at its top */
        unsigned written, compare; /* the register, and what of it is in force */
    } timer;
    enum encoder encoder;
} motors[MOTORS];

static struct wire {
    uint64_t bytes, lost, damaged;
    uint64_t lines; /* put on it whole, empty ones not counted */
    unsigned drop, noise, lose, drop_at, noise_at, fill;
    bool losing;
    char line[160], last[160];
    size_t length;
} to_board, from_board;

/* What the host has asked for, before anything befell it on the wire, and what the firmware makes of
 * it: no set point may be in force that was not asked for just now. */
#define ASKED 8
static struct set_point {
    int hundredths[MOTORS];
} asked[ASKED], in_force, judged;
static char asked_line[160];
static size_t asked_length;
static unsigned asked_at, set_points, wrong;
static uint16_t targets_at;
static int64_t wanted_ns; /* when it last wanted a motor to turn */

static avr_t *avr;
static avr_uart_t *uart;
static avr_ioport_t *port_c;
static avr_ioport_t *ports['L' + 1]; /* with encoders */
static avr_irq_t *uart_input, *adc;
static avr_int_vector_t pin_change;

static const double lag = 0.05;
static double counts_per_turn = 3200;
static double byte_cycles = F_CPU * 10.0 / 115200;
static bool muted, paused, quitting, was_reset, stop_bytes;
static unsigned resets;
static avr_cycle_count_t slept;
static int64_t base_ns, skipped_ns;
static int64_t on_ns, off_ns, heard_ns; /* in virtual time, as is this: from the last byte heard */
static int64_t answer_ns;               /* to the first byte of the line that came then */
static bool motors_run;

/* Bit 0 is pin 37 of the Mega, bit 7 pin 30. */
static uint8_t closed;
static int64_t contact_ns;  /* when a contact was last set */
static int64_t reported_ns; /* when the board had last sent that the emergency stop changed */
static bool reported_pressed;

static int master = -1;
static bool opened; /* somebody has the port open */
static uint8_t incoming[QUEUE], outgoing[QUEUE];
static size_t incoming_head, incoming_tail, outgoing_length;
static uint64_t fetched; /* bytes that the host has written to the port and the board may take */
static bool receiving;

static void fail(const char *format, ...)
{
    va_list arguments;

    va_start(arguments, format);
    vfprintf(stderr, format, arguments);
    va_end(arguments);
    fputc('\n', stderr);
    exit(1);
}

static int64_t clock_ns(clockid_t clock)
{
    struct timespec now;

    clock_gettime(clock, &now);
    return now.tv_sec * NS_PER_S + now.tv_nsec;
}

static int64_t wall_ns(void)
{
    return clock_ns(CLOCK_MONOTONIC);
}

static int64_t virtual_ns(void)
{
    return (int64_t)((__int128)avr->cycle * NS_PER_S / F_CPU);
}

static uint16_t word(uint16_t address)
{
    return (uint16_t)(avr->data[address] | avr->data[address + 1] << 8);
}

/* motors */

static double goal(const struct motor *motor)
{
    return motor->duty * motor->free_speed * (1.0 - motor->load);
}

/* The first-order lag worked out exactly, so that the steps do not matter. */
static void advance(struct motor *motor, avr_cycle_count_t to)
{
    double dt, rest, aim, error;

    if (to <= motor->at)
        return;
    dt = (double)(to - motor->at) / F_CPU;
    motor->at = to;
    aim = goal(motor);
    if (motor->load >= 1.0) {
        motor->speed = 0.0;
        return;
    }
    if (aim == 0.0 && motor->speed == 0.0)
        return;
    rest = exp(-dt / lag);
    error = motor->speed - aim;
    motor->position += (aim * dt + error * lag * (1.0 - rest)) * counts_per_turn / (2.0 * M_PI);
    motor->speed = aim + error * rest;
    if (fabs(motor->speed) < 1e-4 && aim == 0.0)
        motor->speed = 0.0;
}

/* Channel A leads when the motor turns forward. */
static uint8_t levels(const struct motor *motor)
{
    static const uint8_t gray[4] = {0, 1, 3, 2};
    static const uint8_t swapped[4] = {0, 2, 3, 1};

    return (motor->encoder == SWAPPED ? swapped : gray)[motor->counts & 3];
}

static void show_level(struct line line, bool level)
{
    uint8_t mask = (uint8_t)(1u << line.bit);
    avr_ioport_t *port = ports[(int)line.port];

    if (!(avr->data[pin_register(line.port)] & mask) == !level)
        return;
    /* or writing the pull-ups would set all pins */
    port->external.pull_value = (uint8_t)((port->external.pull_value & ~mask) | (level ? mask : 0));
    avr->data[pin_register(line.port)] ^= mask; /* after a reset the next line alone would not do it */
    avr_raise_irq(avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ(line.port), line.bit), level);
    if (line.port == 'K' && avr->data[PCMSK2] & mask)
        avr_raise_interrupt(avr, &pin_change);
}

static void show_encoder(int index)
{
    uint8_t now = levels(&motors[index]);

    if (motors[index].encoder == DEAD)
        return;
    show_level(board->a[index], now & 1);
    show_level(board->b[index], now >> 1);
}

/* Moves one motor and shows at most one edge; returns when to look again. */
static avr_cycle_count_t on_motor(avr_t *unused, avr_cycle_count_t when, void *which)
{
    int index = (int)(intptr_t)which;
    struct motor *motor = &motors[index];
    double wait = SLICE, rate, ahead;

    (void)unused;
    advance(motor, when);
    if (motor->position >= (double)(motor->counts + 1))
        motor->counts++;
    else if (motor->position < (double)motor->counts)
        motor->counts--;
    show_encoder(index);
    rate = motor->speed * counts_per_turn / (2.0 * M_PI) / F_CPU;
    ahead = rate > 0.0 ? (double)(motor->counts + 1) - motor->position
                       : motor->position - (double)motor->counts;
    if (rate != 0.0 && ahead / fabs(rate) < wait)
        wait = ahead / fabs(rate);
    return when + (wait < 16.0 ? 16 : (avr_cycle_count_t)wait + 1);
}

/* An open contact has the level of its pull-up; a pin without one floats, and reads low here. */
static void show_contacts(void)
{
    uint8_t now = (uint8_t)(avr->data[PORTC] & ~avr->data[DDRC] & ~closed);

    avr->data[PINC] = now;
    port_c->external.pull_value = now;
}

static bool set_contact(int pin, const char *value)
{
    int index = 37 - pin;

    if (index < 0 || index > 7)
        return false;
    contact_ns = virtual_ns();
    closed &= (uint8_t)~(1u << index);
    if (!strcmp(value, "closed"))
        closed |= (uint8_t)(1u << index);
    else if (strcmp(value, "open"))
        return false;
    show_contacts();
    return true;
}

static void look_at_bridges(void);

static avr_cycle_count_t on_top(avr_t *unused, avr_cycle_count_t when, void *which)
{
    (void)unused;
    (void)when;
    (void)which;
    look_at_bridges();
    return 0;
}

/* The simulator has no double buffer: in PWM mode a compare register is in force from the next time
 * that the counter, up and down, is at its top; else at once. Looked at whenever one is written. */
static void take_over(int index, bool counts, unsigned top, unsigned cycles, unsigned written)
{
    struct motor *motor = &motors[index];
    avr_cycle_count_t since;

    if (!counts || !motor->timer.counts) {
        motor->timer.counts = counts;
        motor->timer.started = avr->cycle;
        motor->timer.tops = 0;
        motor->timer.written = motor->timer.compare = written;
        return;
    }
    since = (avr->cycle - motor->timer.started) / cycles;
    if ((since + top) / (2 * top) > motor->timer.tops) {
        motor->timer.tops = (since + top) / (2 * top);
        motor->timer.compare = motor->timer.written;
    }
    motor->timer.written = written;
    if (motor->timer.written != motor->timer.compare)
        avr_cycle_timer_register(avr, ((2 * motor->timer.tops + 1) * top - since) * cycles, on_top,
                                 (void *)(intptr_t)index);
}

/* What the PWM pin of a motor gives, 0 to 1: phase correct, at the full clock with its top in ICR or as
 * Arduino's analogWrite has it, or the port when the timer does not have the pin. */
static double pwm(int index)
{
    const struct pwm *pwm = &board->pwm[index];
    uint16_t ddr = pin_register(pwm->line.port) + 1;
    uint8_t a = avr->data[pwm->control_a], b = avr->data[pwm->control_b];
    bool arduino = (a & 3) == 1 && !(b >> 3 & 3) && (b & 7) == pwm->clock;
    unsigned top = arduino ? 255 : word(pwm->top), compare;
    bool counts = arduino || ((a & 3) == 2 && (b >> 3 & 3) == 2 && (b & 7) == 1 && top);
    unsigned mode = a >> pwm->mode_shift & 3;

    take_over(index, counts, top, arduino ? 64 : 1,
              pwm->top ? word(pwm->compare) : avr->data[pwm->compare]);
    compare = motors[index].timer.compare;
    if (!(avr->data[ddr] >> pwm->line.bit & 1))
        return 0.0;
    if (!mode)
        return avr->data[ddr + 1] >> pwm->line.bit & 1;
    if (!counts || mode != 2)
        return 0.0;
    return compare >= top ? 1.0 : (double)compare / top;
}

static uint8_t output(struct line line)
{
    uint16_t ddr = pin_register(line.port) + 1;

    return avr->data[ddr] & avr->data[ddr + 1] & 1 << line.bit ? 1 : 0;
}

static void look_at_bridges(void)
{
    bool any = false;
    int i;

    for (i = 0; i < board->motors; i++) {
        struct motor *motor = &motors[i];
        uint8_t pins = output(board->forward[i]) | output(board->reverse[i]) << 1;
        double size = pwm(i);
        double duty = pins == 1 ? size : pins == 2 ? -size : 0.0;

        if (pins != motor->pins && size > motor->flip_duty)
            motor->flip_duty = size;
        if (duty != motor->duty || pins != motor->pins) {
            advance(motor, avr->cycle);
            motor->duty = duty;
            motor->pins = pins;
        }
        any |= duty != 0.0;
    }
    if (any != motors_run) {
        motors_run = any;
        *(any ? &on_ns : &off_ns) = virtual_ns();
    }
}

/* The real chip ignores a write to ICR while the timer has no mode with its top there. simavr takes it. */
static void check_top(uint16_t address)
{
    uint8_t a = avr->data[address == ICR3 ? TCCR3A : TCCR4A];
    uint8_t b = avr->data[address == ICR3 ? TCCR3B : TCCR4B];

    if (a & 1 || !(b >> 4 & 1))
        fail("the firmware writes ICR of a timer whose mode does not use it: the chip ignores that");
}

static void on_register(avr_irq_t *irq, uint32_t value, void *address)
{
    (void)irq;
    (void)value;
    if (board->motors == 4 && ((intptr_t)address == ICR3 || (intptr_t)address == ICR4))
        check_top((uint16_t)(intptr_t)address);
    look_at_bridges();
    show_contacts();
}

/* the wire */

/* Follows what the host sends. */
static void on_byte_from_host(uint8_t byte)
{
    struct set_point *point = &asked[asked_at % ASKED];
    int i, end = 0;

    if (byte != '\n') {
        if (asked_length < sizeof asked_line - 1)
            asked_line[asked_length++] = (char)byte;
        return;
    }
    asked_line[asked_length] = '\0';
    asked_length = 0;
    for (i = 0; i < MOTORS; i++) {
        int whole, part, used = 0;
        char letter, sign;

        if (sscanf(asked_line + end, "%c%c%2d.%2d%n", &letter, &sign, &whole, &part, &used) < 4 ||
            letter != 'a' + i)
            return;
        point->hundredths[i] = (whole * 100 + part) * (sign == 'n' ? -1 : 1);
        end += used + 1;
    }
    asked_at++;
}

/* A set point counts when it has stood from one slice to the next: the firmware may be writing it. */
static void look_at_targets(void)
{
    struct set_point now;
    bool stands, right = true; /* a stop always is */
    int i;

    if (!targets_at)
        return;
    for (i = 0; i < MOTORS; i++) {
        now.hundredths[i] = (int16_t)word((uint16_t)(targets_at + 2 * i));
        right &= !now.hundredths[i];
    }
    stands = !memcmp(&now, &in_force, sizeof now);
    in_force = now;
    if (stands && !right)
        wanted_ns = virtual_ns();
    if (!stands || !memcmp(&now, &judged, sizeof now))
        return;
    judged = now;
    set_points++;
    for (i = 0; i < ASKED; i++)
        right |= !memcmp(&now, &asked[i], sizeof now);
    wrong += !right;
}

/* What becomes of a byte on it: -1 when it is lost. */
static int carried(struct wire *wire, uint8_t byte)
{
    wire->bytes++;
    if (!wire->fill)
        wire->losing = wire->lose && (unsigned)rand() % 100 < wire->lose;
    wire->fill += byte != '\r';
    if (byte == '\n') {
        wire->lines += wire->fill > 1;
        wire->fill = 0;
    }
    if (wire->losing) {
        wire->lost++;
        wire->losing = byte != '\n';
        return -1;
    }
    if (wire->drop && ++wire->drop_at >= wire->drop) {
        wire->drop_at = 0;
        wire->lost++;
        return -1;
    }
    if (wire->noise && ++wire->noise_at >= wire->noise) {
        wire->noise_at = 0;
        wire->damaged++;
        byte ^= (uint8_t)(1u << (rand() & 7));
    }
    if (byte == '\n') {
        memcpy(wire->last, wire->line, wire->length);
        wire->last[wire->length] = '\0';
        wire->length = 0;
    } else if (byte != '\r' && wire->length < sizeof wire->line - 1) {
        wire->line[wire->length++] = (char)byte;
    }
    return byte;
}

static avr_cycle_count_t on_byte_to_board(avr_t *unused, avr_cycle_count_t when, void *unused2)
{
    int byte;

    (void)unused;
    (void)unused2;
    if (stop_bytes)
        return when + 100;
    if (incoming_head == incoming_tail) {
        receiving = false;
        return 0;
    }
    on_byte_from_host(incoming[incoming_tail % QUEUE]);
    byte = carried(&to_board, incoming[incoming_tail++ % QUEUE]);
    if (byte >= 0) {
        heard_ns = virtual_ns();
        avr_raise_irq(uart_input, (uint32_t)byte);
    }
    return when + (avr_cycle_count_t)byte_cycles;
}

static void on_byte_from_board(avr_irq_t *irq, uint32_t value, void *unused)
{
    int byte;

    (void)irq;
    (void)unused;
    if (!from_board.length)
        answer_ns = virtual_ns() - heard_ns;
    byte = carried(&from_board, (uint8_t)value);
    if (byte < 0)
        return;
    if (byte == '\n' && strstr(from_board.last, " estop=") &&
        reported_pressed != !!strstr(from_board.last, " estop=pressed")) {
        reported_pressed = !reported_pressed;
        reported_ns = virtual_ns();
    }
    if (muted || !opened || outgoing_length == QUEUE)
        from_board.lost++;
    else
        outgoing[outgoing_length++] = (uint8_t)byte;
}

static void on_stop_bytes(avr_irq_t *irq, uint32_t value, void *unused)
{
    (void)irq;
    (void)unused;
    stop_bytes = value;
}

/* The simulator takes eleven bits for a byte, and a doubled speed only when it is set first. */
static void correct_baud_rate(void)
{
    unsigned divider = (word(UBRR0) & 0xFFF) + 1;

    uart->cycles_per_byte = divider * (avr->data[UCSR0A] & 2 ? 8 : 16) * 10;
}

/* the port */

static char *plug(void)
{
    static char path[64];
    struct termios raw;
    int slave;

    master = posix_openpt(O_RDWR | O_NOCTTY | O_NONBLOCK | O_CLOEXEC);
    if (master < 0 || grantpt(master) || unlockpt(master) ||
        ptsname_r(master, path, sizeof path))
        fail("no pty: %s", strerror(errno));
    /* Opened once and closed again: from then on the master is told when nobody has it open. */
    slave = open(path, O_RDWR | O_NOCTTY);
    if (slave < 0 || tcgetattr(slave, &raw))
        fail("no pty: %s", strerror(errno));
    cfmakeraw(&raw); /* like a serial port that echoes nothing */
    tcsetattr(slave, TCSANOW, &raw);
    close(slave);
    opened = false;
    return path;
}

static void unplug(void)
{
    if (master >= 0)
        close(master);
    master = -1;
    opened = false;
    incoming_tail = incoming_head;
    outgoing_length = 0;
}

/* What both the reset pin and the hardware watchdog do to what is around the chip. */
static void after_reset(void)
{
    int i;

    was_reset = false;
    resets++;
    stop_bytes = false;
    receiving = false;
    for (i = 0; i < board->motors; i++) {
        motors[i].counts_at_reset = motors[i].counts;
        show_encoder(i);
        avr_cycle_timer_register(avr, 16, on_motor, (void *)(intptr_t)i);
    }
    show_contacts();
    look_at_bridges();
}

static void reset(void)
{
    avr_reset(avr);
    avr->data[MCUSR] = EXTRF;
    after_reset();
}

static void (*core_reset)(avr_t *);

static void on_reset(avr_t *core)
{
    if (core_reset)
        core_reset(core);
    was_reset = true;
}

static void look_at_port(void)
{
    struct pollfd port = {master, POLLIN, 0};
    uint8_t buffer[512];

    if (master < 0)
        return;
    poll(&port, 1, 0);
    opened = !(port.revents & POLLHUP);
    if (!opened)
        outgoing_length = 0;
    while (port.revents & POLLIN && QUEUE - (incoming_head - incoming_tail) >= sizeof buffer) {
        ssize_t got = read(master, buffer, sizeof buffer), i;

        if (got <= 0)
            break;
        fetched += (uint64_t)got;
        for (i = 0; i < got; i++)
            incoming[incoming_head++ % QUEUE] = buffer[i];
    }
    if (outgoing_length) {
        ssize_t put = write(master, outgoing, outgoing_length);

        /* What the host does not fetch is lost, as on a real line without flow control. */
        if (put < (ssize_t)outgoing_length)
            from_board.lost += outgoing_length - (size_t)(put > 0 ? put : 0);
        outgoing_length = 0;
    }
    if (incoming_head != incoming_tail && !receiving) {
        receiving = true;
        avr_cycle_timer_register(avr, (avr_cycle_count_t)byte_cycles, on_byte_to_board, NULL);
    }
}

/* time */

static void run_slice(void)
{
    avr_cycle_count_t end = avr->cycle + SLICE;

    while (avr->cycle < end) {
        int state = avr_run(avr);

        if (state == cpu_Done || state == cpu_Crashed)
            fail("the firmware crashed at %#x", avr->pc);
        if (was_reset)
            after_reset();
    }
    look_at_targets();
    correct_baud_rate();
}

/* The simulator would wait for the wall clock here; keep_pace does that. */
static void on_sleep(avr_t *unused, avr_cycle_count_t cycles)
{
    (void)unused;
    slept += cycles;
}

/* commands */

static void print_text(const char *name, const char *text)
{
    printf(",\"%s\":\"", name);
    for (; *text; text++) {
        if (*text == '"' || *text == '\\' || (uint8_t)*text < 0x20 || (uint8_t)*text > 0x7E)
            printf("\\u%04x", (uint8_t)*text);
        else
            putchar(*text);
    }
    putchar('"');
}

static void print_wire(const char *name, const struct wire *wire)
{
    printf(",\"%s\":{\"bytes\":%" PRIu64 ",\"lines\":%" PRIu64 ",\"lost\":%" PRIu64
           ",\"damaged\":%" PRIu64, name, wire->bytes, wire->lines, wire->lost, wire->damaged);
    print_text("last", wire->last);
    putchar('}');
}

static void print_status(void)
{
    int i;

    for (i = 0; i < MOTORS; i++)
        advance(&motors[i], avr->cycle);
    printf("{\"virtual_ns\":%" PRId64 ",\"base_ns\":%" PRId64
           ",\"skipped_ns\":%" PRId64 ",\"fetched\":%" PRIu64 ",\"load\":%.4f,\"resets\":%u,\"running\":%s,\"on_ns\":%" PRId64
           ",\"off_ns\":%" PRId64 ",\"heard_ns\":%" PRId64
           ",\"answer_ns\":%" PRId64 ",\"wanted_ns\":%" PRId64 ",\"set_points\":%u,\"wrong\":%u"
           ",\"contact_ns\":%" PRId64
           ",\"reported_ns\":%" PRId64 ",\"motors\":[",
           virtual_ns(), base_ns, skipped_ns, fetched, 1.0 - (double)slept / (double)avr->cycle,
           resets, motors_run ? "true" : "false", on_ns, off_ns, heard_ns, answer_ns, wanted_ns,
           set_points, wrong, contact_ns, reported_ns);
    for (i = 0; i < MOTORS; i++)
        printf("%s{\"duty\":%.6f,\"speed\":%.6f,\"counts\":%" PRId64 ",\"since_reset\":%" PRId64
               ",\"flip_duty\":%.4f}",
               i ? "," : "", motors[i].duty, motors[i].speed, motors[i].counts,
               motors[i].counts - motors[i].counts_at_reset, motors[i].flip_duty);
    putchar(']');
    print_wire("to_board", &to_board);
    print_wire("from_board", &from_board);
    printf("}\n");
}

static void bench(long ms)
{
    int64_t began = wall_ns();
    long slices = ms * 2;

    while (slices-- > 0) {
        run_slice();
        look_at_port();
    }
    base_ns += wall_ns() - began - ms * 1000000;
    printf("{\"ms\":%ld}\n", ms);
}

static bool set_wire(const char *direction, unsigned long n, char what)
{
    struct wire *wire = !strcmp(direction, "to")     ? &to_board
                        : !strcmp(direction, "from") ? &from_board
                                                     : NULL;

    if (!wire)
        return false;
    *(what == 'n' ? &wire->noise : what == 'l' ? &wire->lose : &wire->drop) = (unsigned)n;
    return true;
}

static bool set_motor(const char *what, const char *letter, const char *value)
{
    struct motor *motor = &motors[(letter[0] - 'a') & 3];

    if (letter[0] < 'a' || letter[0] > 'd' || letter[1])
        return false;
    advance(motor, avr->cycle);
    if (!strcmp(what, "load"))
        motor->load = atof(value);
    else if (!strcmp(value, "ok"))
        motor->encoder = OK;
    else if (!strcmp(value, "dead"))
        motor->encoder = DEAD;
    else if (!strcmp(value, "swapped"))
        motor->encoder = SWAPPED;
    else
        return false;
    return true;
}

static bool obeyed(const char *verb, const char *one, const char *two)
{
    if (!strcmp(verb, "reset"))
        reset();
    else if (!strcmp(verb, "pause") || !strcmp(verb, "resume"))
        paused = verb[0] == 'p';
    else if (!strcmp(verb, "mute") || !strcmp(verb, "unmute"))
        muted = verb[0] == 'm';
    else if (!strcmp(verb, "drop") || !strcmp(verb, "noise") || !strcmp(verb, "lose"))
        return set_wire(one, strtoul(two, NULL, 10), verb[0]);
    else if (!strcmp(verb, "type")) {
        for (; *one; one++)
            incoming[incoming_head++ % QUEUE] = (uint8_t)*one;
        incoming[incoming_head++ % QUEUE] = '\n';
    } else if (!strcmp(verb, "unplug"))
        unplug();
    else if (!strcmp(verb, "encoder") || !strcmp(verb, "load"))
        return set_motor(verb, one, two);
    else if (!strcmp(verb, "contact"))
        return set_contact(atoi(one), two);
    else if (!strcmp(verb, "analog"))
        avr_raise_irq(adc + ADC_IRQ_ADC0 + atoi(one), (uint32_t)atoi(two));
    else
        return false;
    return true;
}

static void obey(char *line)
{
    char verb[32] = "", one[32] = "", two[32] = "";

    sscanf(line, "%31s %31s %31s", verb, one, two);
    if (!strcmp(verb, "status"))
        print_status();
    else if (!strcmp(verb, "bench"))
        bench(atol(one));
    else if (!strcmp(verb, "plug")) {
        unplug();
        printf("{\"pty\":\"%s\"}\n", plug());
    } else
        printf("{\"ok\":%s}\n", obeyed(verb, one, two) ? "true" : "false");
}

static void look_at_commands(void)
{
    static char held[1024];
    static size_t length;
    ssize_t got = read(STDIN_FILENO, held + length, sizeof held - length - 1);
    char *line = held, *end;

    if (got <= 0) {
        quitting |= got == 0; /* whoever started us is gone */
        return;
    }
    length += (size_t)got;
    held[length] = '\0';
    while ((end = strchr(line, '\n'))) {
        *end = '\0';
        obey(line);
        line = end + 1;
    }
    length = strlen(line);
    memmove(held, line, length + 1);
    if (length == sizeof held - 1)
        length = 0;
    fflush(stdout);
}

/* Waits until the wall clock has caught up, taking commands and bytes meanwhile. */
static void keep_pace(void)
{
    for (;;) {
        struct pollfd fds[2] = {{STDIN_FILENO, POLLIN, 0}, {opened ? master : -1, POLLIN, 0}};
        struct timespec wait = {0, 0};
        int64_t left = base_ns + virtual_ns() - wall_ns();

        if (left < -CATCH_UP_NS) {
            skipped_ns -= left;
            base_ns -= left;
        }
        if (left > 0)
            wait.tv_nsec = left;
        if (ppoll(fds, 2, &wait, NULL) > 0) {
            if (fds[0].revents)
                look_at_commands();
            if (fds[1].revents)
                look_at_port();
            /* Bytes we have no room for, or a port just closed, would wake us at once again. */
            if (fds[1].revents & (POLLHUP | POLLERR) ||
                QUEUE - (incoming_head - incoming_tail) < 512)
                return;
        }
        if (left <= 0 || quitting)
            return;
    }
}

static void *module(const char *kind, char name)
{
    avr_io_t *io;

    for (io = avr->io_port; io; io = io->next) {
        if (strcmp(io->kind, kind))
            continue;
        if (!strcmp(kind, "uart") ? ((avr_uart_t *)io)->name == name
                                  : ((avr_ioport_t *)io)->name == name)
            return io;
    }
    fail("this libsimavr has no %s %c", kind, name);
    return NULL;
}

static void say_nothing(avr_t *unused, const int level, const char *format, va_list arguments)
{
    (void)unused;
    if (level <= LOG_ERROR)
        vfprintf(stderr, format, arguments);
}

static void watch(uint16_t address)
{
    static bool watched[0x200];

    if (watched[address])
        return;
    watched[address] = true;
    avr_irq_register_notify(avr_iomem_getirq(avr, address, NULL, AVR_IOMEM_IRQ_ALL), on_register,
                            (void *)(intptr_t)address);
}

static void power_on(const char *path)
{
    elf_firmware_t firmware;
    uint32_t no_flags = 0;
    size_t i;
    int motor;

    memset(&firmware, 0, sizeof firmware);
    if (elf_read_firmware(path, &firmware))
        fail("%s: not a firmware", path);
    avr = avr_make_mcu_by_name(board->chip);
    if (!avr)
        fail("this libsimavr has no %s", board->chip);
    avr_global_logger_set(say_nothing);
    avr_init(avr);
    firmware.frequency = F_CPU;
    avr_load_firmware(avr, &firmware);
    for (i = 0; i < firmware.symbolcount; i++)
        if (!strcmp(firmware.symbol[i]->symbol, "targets"))
            targets_at = (uint16_t)firmware.symbol[i]->addr;
    avr->sleep = on_sleep;
    core_reset = avr->reset;
    avr->reset = on_reset;

    uart = module("uart", '0');
    port_c = module("port", 'C');
    port_c->external.pull_mask = 0xFF;
    for (motor = 0; motor < 2 * board->motors; motor++) {
        struct line line = (motor % 2 ? board->a : board->b)[motor / 2];

        ports[(int)line.port] = module("port", line.port);
        ports[(int)line.port]->external.pull_mask |= (uint8_t)(1u << line.bit);
    }
    adc = avr_io_getirq(avr, AVR_IOCTL_ADC_GETIRQ, 0);
    avr->vcc = avr->avcc = avr->aref = 5000;
    avr_ioctl(avr, AVR_IOCTL_UART_SET_FLAGS('0'), &no_flags);
    uart_input = avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_INPUT);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUTPUT),
                            on_byte_from_board, NULL);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUT_XOFF),
                            on_stop_bytes, NULL);

    /* The simulator knows the pin change interrupt of port B only. */
    pin_change.vector = PCINT2;
    pin_change.enable = (avr_regbit_t)AVR_IO_REGBIT(PCICR, 2);
    pin_change.raised = (avr_regbit_t)AVR_IO_REGBIT(PCIFR, 2);
    avr_register_vector(avr, &pin_change);

    watch(PORTC), watch(DDRC);
    for (motor = 0; motor < board->motors; motor++) {
        const struct pwm *pwm = &board->pwm[motor];

        watch(pwm->control_a), watch(pwm->control_b), watch(pwm->compare);
        if (pwm->top)
            watch(pwm->top);
        for (i = 1; i < 3; i++) {
            watch(pin_register(pwm->line.port) + (uint16_t)i);
            watch(pin_register(board->forward[motor].port) + (uint16_t)i);
            watch(pin_register(board->reverse[motor].port) + (uint16_t)i);
        }
    }
    after_reset();
    resets = 0;
}

int main(int count, char **words)
{
    struct sched_param priority = {.sched_priority = 1};
    int i;

    for (i = 0; i < MOTORS; i++)
        motors[i].free_speed = 50.0;
    for (i = 1; i + 1 < count; i += 2) {
        const char *value = words[i + 1];

        if (!strcmp(words[i], "--baud"))
            byte_cycles = F_CPU * 10.0 / atof(value);
        else if (!strcmp(words[i], "--counts"))
            counts_per_turn = atof(value);
        else if (!strcmp(words[i], "--free-speed"))
            sscanf(value, "%lf,%lf,%lf,%lf", &motors[0].free_speed, &motors[1].free_speed,
                   &motors[2].free_speed, &motors[3].free_speed);
        else if (!strcmp(words[i], "--board")) {
            while (board < BOARDS + sizeof BOARDS / sizeof *BOARDS && strcmp(board->name, value))
                board++;
            if (board == BOARDS + sizeof BOARDS / sizeof *BOARDS)
                fail("unknown board %s", value);
        } else
            fail("unknown option %s", words[i]);
    }
    if (i != count - 1)
        fail("usage: runner [OPTION VALUE]... FIRMWARE.elf");
    power_on(words[count - 1]);
    /* Not root: the board is as fast as the machine is idle. */
    (void)!sched_setscheduler(0, SCHED_FIFO, &priority);
    printf("{\"pty\":\"%s\"}\n", plug());
    fflush(stdout);
    base_ns = wall_ns();
    while (!quitting) {
        if (paused)
            base_ns = wall_ns() - virtual_ns() + NS_PER_S / 2000;
        else
            run_slice();
        look_at_port();
        keep_pace();
    }
    unplug();
    return 0;
}
