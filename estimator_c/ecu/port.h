/* What the replay of recorded steps needs of the machine it runs on: a counter of instructions, the depth of the stack,
 * a file to read and one to write. an500_port.c is the emulated ECU's, host_port.c this machine's, where there is neither
 * counter nor painted stack and both read 0. One thread. */
#ifndef PORT_H
#define PORT_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

enum { PORT_DONE = 0, PORT_BAD_STREAM = 3, PORT_NO_FILE = 4, PORT_FAULT = 5 }; /* exit status */

/* Open `stream.bin` for reading and `result.bin` for writing in the working folder; start the counter. Does not return
 * when that fails: PORT_NO_FILE. */
void port_open(void);

/* Next `bytes` of the stream; false at its end. */
bool port_read(void *to, size_t bytes);

/* Append to the result; buffered until port_exit(). */
void port_write(const void *from, size_t bytes);

/* Counter that grows by 25.6 with each instruction, modulo 2^32: 168 million instructions. Reading it costs the same
 * always. */
uint32_t port_ticks(void);

/* Paint 16 kB of the stack below the caller; bytes of it used since (16 kB: all of it, or more). */
void port_stack_paint(void);
uint32_t port_stack_depth(void);

/* A loop of two instructions a round, to try the counter on: the ticks it took. */
uint32_t port_known_loop(uint32_t rounds);

/* Write what is buffered, end the program with that status. */
_Noreturn void port_exit(int status);

#endif
