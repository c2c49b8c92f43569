#include "ctl_preview.h"

#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { LINE_LENGTH = 128, FIRST_POINT_LINE = 3 };

/* The next line without its end, hashed as it stands. False at the end of the file or for a line that is too long. */
static bool next_line(FILE *in, char line[LINE_LENGTH], uint32_t *hash) {
    if (fgets(line, LINE_LENGTH, in) == NULL) {
        return false;
    }
    for (const char *c = line; *c != '\0'; c++) {
        *hash = (*hash ^ (uint8_t)*c) * UINT32_C(0x01000193);
    }
    const size_t length = strlen(line);
    if (length == 0 || line[length - 1] != '\n') {
        return false;
    }
    line[length - 1] = '\0';
    return true;
}

/* `count` finite numbers and nothing else. */
static bool numbers(const char *line, double out[], int count) {
    for (int i = 0; i < count; i++) {
        char *end = NULL;
        out[i] = strtod(line, &end);
        if (end == line || !isfinite(out[i])) {
            return false;
        }
        line = end;
    }
    return *line == '\0';
}

static bool header(FILE *in, char line[LINE_LENGTH], uint32_t *hash, double head[3]) {
    return next_line(in, line, hash) && strcmp(line, "rt-preview 1") == 0 && next_line(in, line, hash) &&
           numbers(line, head, 3) && head[0] > 0.0 && head[1] >= 2.0 && head[1] <= CTL_PREVIEW_POINTS &&
           head[1] == floor(head[1]) && head[2] >= 0.0;
}

static ctl_preview_status malformed(ctl_preview *self, long line) {
    (void)snprintf(self->error, sizeof self->error, "line %ld is not that of a preview of 2 to %d points; write it "
                   "with python -m plant_sim.preview", line, (int)CTL_PREVIEW_POINTS);
    return CTL_PREVIEW_MALFORMED;
}

static ctl_preview_status read_from(ctl_preview *self, FILE *in) {
    char line[LINE_LENGTH];
    double head[3], point[2];
    uint32_t hash = UINT32_C(0x811C9DC5);
    if (!header(in, line, &hash, head)) {
        return malformed(self, 1);
    }
    const int32_t count = (int32_t)head[1];
    for (int32_t k = 0; k < count; k++) {
        if (!next_line(in, line, &hash) || !numbers(line, point, 2) || point[0] < 0.0) {
            return malformed(self, (long)k + FIRST_POINT_LINE);
        }
        self->v_ref_mps[k] = point[0];
        self->slope_rad[k] = point[1];
    }
    if (next_line(in, line, &hash) || ferror(in) != 0) {
        return malformed(self, (long)count + FIRST_POINT_LINE);
    }
    self->road = (controller_road_t){.v_ref_mps = self->v_ref_mps, .slope_rad = self->slope_rad, .count = count,
                                     .step_m = head[0], .lookahead_m = head[2]};
    self->fingerprint = (hash >> 24) ^ (hash & 0xFFFFFFU);
    return CTL_PREVIEW_OK;
}

ctl_preview_status ctl_preview_load(ctl_preview *self, const char *path) {
    memset(&self->road, 0, sizeof self->road);
    self->fingerprint = 0;
    self->error[0] = '\0';
    FILE *in = fopen(path, "r");
    if (in == NULL) {
        (void)snprintf(self->error, sizeof self->error, "%s", strerror(errno));
        return CTL_PREVIEW_UNREADABLE;
    }
    const ctl_preview_status status = read_from(self, in);
    (void)fclose(in);
    return status;
}
