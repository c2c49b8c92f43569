#include "injection.h"

#include <errno.h>
#include <stdlib.h>
#include <string.h>

/* A whole number low..high that ends at `end`; *text is moved behind it. */
static bool take_number(const char **text, char end, unsigned long long low, unsigned long long high, unsigned long long *out) {
    char *stop = NULL;
    if (**text < '0' || **text > '9') { /* strtoull would take a sign and blanks */
        return false;
    }
    errno = 0;
    *out = strtoull(*text, &stop, 10);
    if (errno != 0 || *stop != end || *out < low || *out > high) {
        return false;
    }
    *text = stop + 1;
    return true;
}

bool injections_add(injections *self, const char *text) {
    static const char *const names[] = {"compute:", "sleep:"};
    unsigned long long us = 0;
    unsigned long long release = 0;
    for (size_t kind = 0; kind < sizeof names / sizeof names[0]; kind++) {
        const size_t length = strlen(names[kind]);
        const char *rest = text + length;
        if (strncmp(text, names[kind], length) == 0 && self->count < INJECTIONS_MAX &&
            take_number(&rest, '@', 1, INJECTION_MAX_US, &us) &&
            take_number(&rest, '\0', 1, UINT64_MAX >> 1U, &release)) {
            self->item[self->count++] = (injection){(injection_kind)kind, (int64_t)us * 1000, release};
            return true;
        }
    }
    return false;
}
