/* The port of an ordinary machine: files by stdio, no instruction counter, no painted stack. */
#include "port.h"

#include <stdio.h>
#include <stdlib.h>

static FILE *in;
static FILE *out;

void port_open(void)
{
    in = fopen("stream.bin", "rb");
    out = fopen("result.bin", "wb");
    if (in == NULL || out == NULL) {
        exit(PORT_NO_FILE);
    }
}

bool port_read(void *to, size_t bytes)
{
    return fread(to, 1, bytes, in) == bytes;
}

void port_write(const void *from, size_t bytes)
{
    if (fwrite(from, 1, bytes, out) != bytes) {
        exit(PORT_NO_FILE);
    }
}

uint32_t port_ticks(void)
{
    return 0;
}

void port_stack_paint(void)
{
}

uint32_t port_stack_depth(void)
{
    return 0;
}

uint32_t port_known_loop(uint32_t rounds)
{
    (void)rounds;
    return 0;
}

_Noreturn void port_exit(int status)
{
    const int closed = out != NULL ? fclose(out) : 0;
    exit(closed == 0 ? status : PORT_NO_FILE);
}
