/* What the estimator's step uses of <string.h>; memory.c has it. strcmp() is declared for est_setting_find(), which an
 * image without a command line never calls and the linker drops. */
#ifndef ECU_STRING_H
#define ECU_STRING_H

#include <stddef.h>

void *memcpy(void *restrict to, const void *restrict from, size_t bytes);
void *memset(void *to, int value, size_t bytes);
int strcmp(const char *a, const char *b);

#endif
