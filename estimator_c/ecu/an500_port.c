/* The port of qemu-system-arm -M mps2-an500 -icount shift=10 with semihosting.
 *
 * An instruction takes 1024 ns of virtual time there and the board's timers count 25 MHz of it, so an instruction is
 * 25.6 ticks and a difference of two readings says how many there were, exactly. No cycle counter (DWT) is emulated,
 * nor anything that would give it a meaning: pipeline, caches, flash wait states. */
#include "port.h"

#include <string.h>

/* CMSDK timer 0 of the board: counts down from RELOAD. */
static volatile uint32_t *const TIMER_CTRL = (uint32_t *)0x40000000u;
static volatile uint32_t *const TIMER_VALUE = (uint32_t *)0x40000004u;
static volatile uint32_t *const TIMER_RELOAD = (uint32_t *)0x40000008u;

enum { SYS_OPEN = 0x01, SYS_WRITE = 0x05, SYS_READ = 0x06, SYS_EXIT_EXTENDED = 0x20 };
enum { OPEN_RB = 1, OPEN_WB = 5 };
#define ADP_STOPPED_APPLICATION_EXIT 0x20026u

enum { BUFFER = 65536 };
static uint8_t in[BUFFER], out[BUFFER];
static size_t in_at, in_end, out_end;
static uint32_t in_file, out_file;

enum { PAINTED_WORDS = 4096, OWN_WORDS = 16 }; /* below the caller; of them, left to the painter's own frame */
static uint32_t *painted_top;
static const uint32_t PAINT = 0xC5C5C5C5u;

static uint32_t semihost(uint32_t operation, const void *argument)
{
    register uint32_t r0 __asm__("r0") = operation;
    register const void *r1 __asm__("r1") = argument;
    __asm__ volatile("bkpt 0xab" : "+r"(r0) : "r"(r1) : "memory");
    return r0;
}

static uint32_t open_file(const char *name, uint32_t length, uint32_t mode)
{
    const uint32_t argument[3] = {(uint32_t)name, mode, length};
    const uint32_t file = semihost(SYS_OPEN, argument);
    if (file == UINT32_MAX) {
        port_exit(PORT_NO_FILE);
    }
    return file;
}

void port_open(void)
{
    in_at = in_end = out_end = 0; /* the bench's memory is not cleared at start */
    out_file = UINT32_MAX;
    in_file = open_file("stream.bin", 10, OPEN_RB);
    out_file = open_file("result.bin", 10, OPEN_WB);
    *TIMER_RELOAD = UINT32_MAX;
    *TIMER_VALUE = UINT32_MAX;
    *TIMER_CTRL = 1u;
}

bool port_read(void *to, size_t bytes)
{
    uint8_t *next = to;
    while (bytes > 0) {
        if (in_at == in_end) {
            const uint32_t argument[3] = {in_file, (uint32_t)in, BUFFER};
            in_at = 0;
            in_end = BUFFER - semihost(SYS_READ, argument); /* it returns what it could not read */
            if (in_end == 0) {
                return false;
            }
        }
        const size_t part = bytes < in_end - in_at ? bytes : in_end - in_at;
        memcpy(next, in + in_at, part);
        next += part;
        in_at += part;
        bytes -= part;
    }
    return true;
}

static bool flush(void)
{
    const uint32_t argument[3] = {out_file, (uint32_t)out, out_end};
    const bool written = out_end == 0 || semihost(SYS_WRITE, argument) == 0;
    out_end = 0;
    return written;
}

void port_write(const void *from, size_t bytes)
{
    if (out_end + bytes > BUFFER && !flush()) {
        port_exit(PORT_NO_FILE);
    }
    memcpy(out + out_end, from, bytes);
    out_end += bytes;
}

uint32_t port_ticks(void)
{
    return ~*TIMER_VALUE;
}

void port_stack_paint(void)
{
    painted_top = (uint32_t *)__builtin_frame_address(0) - OWN_WORDS;
    for (uint32_t *word = painted_top - PAINTED_WORDS; word < painted_top; word++) {
        *word = PAINT;
    }
}

uint32_t port_stack_depth(void)
{
    const uint32_t *word = painted_top - PAINTED_WORDS;
    while (word < painted_top && *word == PAINT) {
        word++;
    }
    return (uint32_t)(painted_top + OWN_WORDS - word) * (uint32_t)sizeof *word;
}

uint32_t port_known_loop(uint32_t rounds)
{
    const uint32_t begin = port_ticks();
    __asm__ volatile("1: subs %0, %0, #1\n bne 1b" : "+r"(rounds) : : "cc");
    return port_ticks() - begin;
}

_Noreturn void port_exit(int status)
{
    if (out_file != UINT32_MAX && !flush()) {
        status = PORT_NO_FILE;
    }
    const uint32_t argument[2] = {ADP_STOPPED_APPLICATION_EXIT, (uint32_t)status};
    for (;;) {
        (void)semihost(SYS_EXIT_EXTENDED, argument);
    }
}
