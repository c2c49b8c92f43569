#include "rt_reaction.h"

#include <stddef.h>
#include <string.h>

static const uint64_t LARGEST = 1000000000;

/* Reads a whole number without sign at *text and moves behind it. */
static bool number(const char **text, uint64_t low, uint64_t high, uint64_t *value) {
    const char *c = *text;
    uint64_t sum = 0;
    if (*c < '0' || *c > '9') {
        return false;
    }
    for (; *c >= '0' && *c <= '9'; c++) {
        sum = sum * 10U + (uint64_t)(*c - '0');
        if (sum > high) {
            return false;
        }
    }
    *text = c;
    *value = sum;
    return sum >= low;
}

/* The number behind `prefix`, with nothing after it. */
static bool argument(const char *text, const char *prefix, uint64_t high, uint64_t *value) {
    const size_t length = strlen(prefix);
    const char *rest = text + length;
    return strncmp(text, prefix, length) == 0 && number(&rest, 1, high, value) && *rest == '\0';
}

bool rt_reaction_parse(const char *text, rt_reaction *out) {
    rt_reaction reaction = {RT_OVERRUN_SKIP, 0, 0, 0, 0};
    uint64_t value = 0;
    if (strcmp(text, "rebase") == 0) {
        reaction.overrun = RT_OVERRUN_REBASE;
    } else if (argument(text, "queue:", RT_QUEUE_MAX, &value)) {
        reaction.overrun = RT_OVERRUN_QUEUE;
        reaction.queue_limit = (uint32_t)value;
    } else if (argument(text, "cut:", LARGEST, &value)) {
        reaction.budget_ns = (int64_t)value * 1000;
    } else if (argument(text, "stop:total:", LARGEST, &value)) {
        reaction.stop_total = value;
    } else if (argument(text, "stop:row:", LARGEST, &value)) {
        reaction.stop_row = value;
    } else if (strcmp(text, "skip") != 0) {
        return false;
    }
    *out = reaction;
    return true;
}

bool rt_mk_parse(const char *text, uint32_t *m, uint32_t *k) {
    uint64_t misses = 0;
    uint64_t window = 0;
    if (!number(&text, 0, RT_MK_WINDOW - 1U, &misses) || (*text != ',' && *text != ':')) {
        return false;
    }
    text++;
    if (!number(&text, misses + 1U, RT_MK_WINDOW, &window) || *text != '\0') {
        return false;
    }
    *m = (uint32_t)misses;
    *k = (uint32_t)window;
    return true;
}

bool rt_reaction_valid(const rt_reaction *self, int64_t deadline_ns) {
    const bool queue = self->overrun == RT_OVERRUN_QUEUE;
    return (queue || self->overrun == RT_OVERRUN_SKIP || self->overrun == RT_OVERRUN_REBASE) &&
           (queue ? self->queue_limit >= 1 && self->queue_limit <= RT_QUEUE_MAX : self->queue_limit == 0) &&
           self->budget_ns >= 0 && self->budget_ns <= deadline_ns;
}
