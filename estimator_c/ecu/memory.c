/* memcpy and memset: what a C compiler calls on its own, without a C library. Words where both ends are aligned. */
#include <stdint.h>
#include <string.h>

typedef uint32_t __attribute__((may_alias)) word_t;

void *memcpy(void *restrict to, const void *restrict from, size_t bytes)
{
    unsigned char *out = to;
    const unsigned char *in = from;
    if ((((uintptr_t)out | (uintptr_t)in) & (sizeof(word_t) - 1)) == 0) {
        for (; bytes >= sizeof(word_t); bytes -= sizeof(word_t)) {
            *(word_t *)(void *)out = *(const word_t *)(const void *)in;
            out += sizeof(word_t);
            in += sizeof(word_t);
        }
    }
    while (bytes-- > 0) {
        *out++ = *in++;
    }
    return to;
}

void *memset(void *to, int value, size_t bytes)
{
    unsigned char *out = to;
    if (((uintptr_t)out & (sizeof(word_t) - 1)) == 0) {
        const word_t word = 0x01010101u * (unsigned char)value;
        for (; bytes >= sizeof(word_t); bytes -= sizeof(word_t)) {
            *(word_t *)(void *)out = word;
            out += sizeof(word_t);
        }
    }
    while (bytes-- > 0) {
        *out++ = (unsigned char)value;
    }
    return to;
}
