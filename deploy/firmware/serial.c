#include "serial.h"

#include <avr/interrupt.h>
#include <avr/io.h>
#include <util/atomic.h>

#include "config.h"

#define BAUD BAUD_RATE
#define BAUD_TOL 3 /* 115200 baud at 16 MHz is 2.1 % fast: within what 8N1 takes */
#include <util/setbaud.h>

/* Rings of 256: their indices wrap by themselves, and one byte is written in one instruction. */
static volatile uint8_t received[256];
static volatile uint8_t received_head, received_tail;
static volatile uint8_t to_send[256];
static volatile uint8_t to_send_head, to_send_tail;

void serial_start(void)
{
    UBRR0 = UBRR_VALUE;
    UCSR0A = USE_2X ? _BV(U2X0) : 0;
    UCSR0C = _BV(UCSZ01) | _BV(UCSZ00); /* 8N1 */
    UCSR0B = _BV(RXEN0) | _BV(TXEN0) | _BV(RXCIE0);
}

ISR(USART0_RX_vect)
{
    static bool lost;
    uint8_t status = UCSR0A; /* before the byte: reading that moves on */
    uint8_t byte = UDR0;
    uint8_t room = (uint8_t)(received_tail - received_head - 1);

    if (status & _BV(DOR0))
        lost = true;
    if (status & _BV(FE0))
        byte = '\0';
    if (room < 3) {
        lost = true;
        return;
    }
    if (lost) {
        /* Ends the line with the hole. What follows stands alone: the rest of a line is never a
         * line, and a line that begins here is whole. */
        received[received_head++] = '\0';
        received[received_head++] = '\n';
        lost = false;
    }
    received[received_head++] = byte;
}

bool serial_idle(void)
{
    return received_head == received_tail;
}

bool serial_read(uint8_t *byte)
{
    if (serial_idle())
        return false;
    *byte = received[received_tail++];
    return true;
}

ISR(USART0_UDRE_vect)
{
    if (to_send_head == to_send_tail)
        UCSR0B &= (uint8_t)~_BV(UDRIE0);
    else
        UDR0 = to_send[to_send_tail++];
}

bool serial_write(const char *text, uint8_t length)
{
    uint8_t room = (uint8_t)(to_send_tail - to_send_head - 1), head = to_send_head;

    if (room < length)
        return false;
    while (length--)
        to_send[head++] = (uint8_t)*text++;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        to_send_head = head;
        UCSR0B |= _BV(UDRIE0);
    }
    return true;
}

bool serial_sent(void)
{
    return to_send_head == to_send_tail;
}
