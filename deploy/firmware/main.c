/* The robot's microcontroller: a line comes in, four wheels turn at its speeds, a line goes out.
 *
 * After boot the motors stand until a whole valid line has arrived. They are stopped if no line arrives
 * for COMMAND_WATCHDOG_MS, if a wheel runs away, and while the emergency stop is pressed. If this loop
 * or its control hangs, the hardware watchdog resets the board, and the motors stand again.
 *
 * The interrupts only count edges, milliseconds and bytes; all else happens in the loop below, so
 * nothing but its own data needs a guard.
 */
#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/sleep.h>
#include <avr/wdt.h>

#include "bridge.h"
#include "config.h"
#include "hardware.h"
#include "line.h"
#include "pi.h"
#include "serial.h"
#include "speed.h"
#include "status.h"
#include "supervise.h"
#include "watchdog.h"

/* Replies within REPORT_MS repeat a reading. After RENEW_MS it is renewed without a line of the host. So
 * the speed in a reply covers 5 to 25 ms at any rate of the host. */
#define REPORT_MS 5
#define RENEW_MS 20

static struct {
    struct pi pi;
    struct bridge bridge;
    struct speed control, report; /* over one control period; since the last report */
    struct supervisor supervisor;
    bool limited;
} wheels[MOTORS];

/* Commanded speeds of the wheels, hundredths of a rad/s. The bench finds this array by its name. */
static int16_t targets[MOTORS] __attribute__((used));

static struct watchdog watchdog;
static struct snapshot latest;
static struct reading report;
static uint32_t report_ms, control_ms;
static bool checked_seen, stop_seen; /* since boot */
static bool astray; /* a wheel did not obey: motors off until the host is silent */
static bool halted; /* the emergency stop was pressed: off until it is released and a stop came */
static struct status status;
static struct line_reader reader;
static struct record record;
static uint8_t reset_flags __attribute__((section(".noinit"))); /* set before the rest is zeroed */

/* The hardware watchdog stays on after the reset that it causes, with 16 ms. Switch it off first. */
void watchdog_off(void) __attribute__((naked, used, section(".init3")));
void watchdog_off(void)
{
    reset_flags = MCUSR;
    MCUSR = 0;
    wdt_disable();
}

/* A bootloader may have cleared the flags. Switching the power on sets other flags too. */
static const char *reset_cause(void)
{
    if (reset_flags & _BV(PORF))
        return "power";
    if (reset_flags & _BV(BORF))
        return "brown-out";
    if (reset_flags & _BV(WDRF))
        return "watchdog";
    return reset_flags & _BV(EXTRF) ? "pin" : "unknown";
}

static void say_identity(void)
{
    struct record told = record;
    char text[IDENTITY_MAX];
    uint16_t room = UINT16_MAX - told.refused;

    told.refused += reader.too_long < room ? reader.too_long : room;
    serial_write(text, line_identity(text, &told, reset_cause()));
}

static void motors_off(void)
{
    uint8_t i;

    hardware_motors_off();
    for (i = 0; i < MOTORS; i++) {
        targets[i] = 0;
        wheels[i].limited = false;
        pi_reset(&wheels[i].pi);
        bridge_off(&wheels[i].bridge);
        supervise_start(&wheels[i].supervisor);
    }
}

static bool motors_have_voltage(void)
{
    uint8_t i;

    for (i = 0; i < MOTORS; i++)
        if (wheels[i].bridge.duty)
            return true;
    return false;
}

static void renew_report(void)
{
    uint8_t i;

    report_ms = latest.milliseconds;
    report.milliseconds = (uint16_t)latest.milliseconds;
    for (i = 0; i < MOTORS; i++) {
        float speed =
            speed_update(&wheels[i].report, latest.counts[i], latest.edges[i], latest.now);

        report.counts[i] = latest.counts[i];
        report.hundredths[i] = speed_hundredths(speed);
    }
}

static void control(bool allowed)
{
    uint8_t i;

    for (i = 0; i < MOTORS; i++) {
        float speed =
            speed_update(&wheels[i].control, latest.counts[i], latest.edges[i], latest.now);
        struct bridge *bridge = &wheels[i].bridge;
        float duty;

        if (!allowed)
            continue;
        if (supervise_step(&wheels[i].supervisor, (int16_t)(bridge->duty * bridge->direction),
                           speed, latest.counts[i]))
            astray = true;
        duty = pi_step(&wheels[i].pi, (float)targets[i] * 0.01f, speed, wheels[i].limited);
        wheels[i].limited = !bridge_step(bridge, (int16_t)(duty * PWM_TOP));
        hardware_motor(i, bridge->duty, bridge->direction);
    }
    if (allowed && astray) {
        motors_off();
        count_up(&record.runaways);
    }
}

static void look_at_inputs(void)
{
    uint8_t analog;
    int16_t reading = HAS_ANALOGS ? hardware_reading(&analog) : -1;

    if (reading >= 0)
        status_reading(&status, analog, (uint16_t)reading);
    if (HAS_CONTACTS)
        status_contacts(&status, hardware_contacts());
    if (status_stopped(&status))
        halted = true;
}

/* A status line is sent only after all replies, so it never takes the place of a reply, and a reply waits
 * for one status line at most. */
static void report_inputs(void)
{
    char text[STATUS_MAX];
    uint8_t length = serial_sent() ? status_line(&status, latest.milliseconds, text) : 0;

    if (length)
        serial_write(text, length);
}

static void on_millisecond(void)
{
    bool fed, allowed;

    hardware_snapshot(&latest);
    if (HAS_INPUTS)
        look_at_inputs();
    fed = watchdog_allows(&watchdog, latest.milliseconds);
    if (!fed && motors_have_voltage())
        count_up(&record.trips);
    astray = astray && fed;
    allowed = fed && !astray && !halted;
    if (!allowed)
        motors_off();
    if (HAS_INPUTS)
        report_inputs();
    if (latest.milliseconds - report_ms >= RENEW_MS)
        renew_report();
    if (latest.milliseconds - control_ms >= CONTROL_MS) {
        control_ms += CONTROL_MS;
        if (latest.milliseconds - control_ms >= CONTROL_MS)
            control_ms = latest.milliseconds; /* late: go on from here, do not catch up */
        control(allowed);
        wdt_reset(); /* only here, so that a hanging loop or control causes a reset */
    }
}

static bool is_stop(const struct command *command)
{
    uint8_t i;

    for (i = 0; i < MOTORS; i++)
        if (command->hundredths[i])
            return false;
    return true;
}

/* After a boot only a stop is accepted, until one has arrived. A host that has not noticed the reset goes
 * on commanding speeds, and the robot would lurch with its next line. The board sends the identification
 * again instead, in case the one after boot was lost. */
static bool takes(const struct command *command)
{
    if (is_stop(command))
        return true; /* from any host and in any form */
    if (REQUIRE_CHECK && checked_seen && !command->checked)
        return false;
    if (!stop_seen)
        say_identity();
    return stop_seen;
}

static void on_command(const struct command *command)
{
    char text[REPLY_MAX];
    uint8_t i;

    stop_seen = true;
    checked_seen |= command->checked;
    record.lines++;
    if (HAS_INPUTS && is_stop(command))
        halted = false; /* for a millisecond, while it is still pressed */
    for (i = 0; i < MOTORS; i++)
        targets[i] = astray || halted ? 0 : command->hundredths[i];
    watchdog_feed(&watchdog, latest.milliseconds);
    if (latest.milliseconds - report_ms >= REPORT_MS)
        renew_report();
    serial_write(text, line_reply(text, command, &report));
}

#ifdef TEST_HANG
#include <util/delay.h>

/* For tests only: the kinds of hang that the hardware watchdog must catch, and one that it must not. */
static void hang(const char *text, uint8_t length)
{
    if (length != 2 || text[0] != '!')
        return;
    if (text[1] == 'c')
        TIMSK0 = 0; /* stop the clock: no more control ticks, but the loop goes on */
    if (text[1] == 'p')
        _delay_ms(60.0);
    if (text[1] == 'i')
        cli();
    while (text[1] == 'i' || text[1] == 'l')
        ;
}
#endif

static void on_line(const char *text, uint8_t length)
{
    struct command command;

    if (line_parse(text, length, &command) && takes(&command)) {
        on_command(&command);
    } else if (line_asks(text, length)) {
        say_identity();
    } else {
        count_up(&record.refused);
#ifdef TEST_HANG
        hang(text, length);
#endif
    }
}

/* Any interrupt ends the sleep. None can come between the test and the begin of the sleep. */
static void wait(void)
{
    cli();
    if (!hardware_ticked() && serial_idle()) {
        sleep_enable();
        sei(); /* takes effect after the next instruction */
        sleep_cpu();
        sleep_disable();
    }
    sei();
}

int main(void)
{
    uint8_t i;

    hardware_start();
    serial_start();
    set_sleep_mode(SLEEP_MODE_IDLE);
    wdt_enable(WDTO_120MS);
    watchdog_start(&watchdog);
    if (HAS_INPUTS)
        status_start(&status);
    motors_off();
    for (i = 0; i < MOTORS; i++) {
        speed_start(&wheels[i].control, 0, 0);
        speed_start(&wheels[i].report, 0, 0);
    }
    sei();
    serial_write("\r\n", 2); /* a reset may have cut a reply in two: end it */
    say_identity();
    for (;;) {
        uint8_t byte, length = 0;

        wait();
        if (hardware_ticked())
            on_millisecond();
        /* One line at most, so that a flood of them cannot keep the control waiting. */
        while (!length && serial_read(&byte))
            length = line_feed(&reader, byte);
        if (length)
            on_line(reader.text, length);
    }
}
