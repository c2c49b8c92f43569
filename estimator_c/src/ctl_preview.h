/* The road ahead, read from the file that `python -m plant_sim.preview` writes: a line "rt-preview 1", a line with
 * step in m, number of points and look-ahead in m, then reference speed (m/s) and slope (rad) of every point.
 *
 * For set-up only: it reads a file with stdio. The caller owns the object (1 MB: static storage) and keeps it as
 * long as the controller that drives on it. */
#ifndef CTL_PREVIEW_H
#define CTL_PREVIEW_H

#include <stdint.h>

#include "controller.h"

enum { CTL_PREVIEW_POINTS = 65536, CTL_PREVIEW_ERROR_LENGTH = 160 };

typedef enum {
    CTL_PREVIEW_OK = 0,
    CTL_PREVIEW_UNREADABLE = 1, /* the system refused; `error` says why */
    CTL_PREVIEW_MALFORMED = 2   /* `error` says in which line */
} ctl_preview_status;

typedef struct {
    controller_road_t road;    /* points into this object */
    uint32_t fingerprint;      /* FNV-1a of the file, folded to 24 bits */
    char error[CTL_PREVIEW_ERROR_LENGTH];
    double v_ref_mps[CTL_PREVIEW_POINTS];
    double slope_rad[CTL_PREVIEW_POINTS];
} ctl_preview;

/* Reads `path`. Milliseconds for a lap. After a failure `self` holds the error only. */
ctl_preview_status ctl_preview_load(ctl_preview *self, const char *path);

#endif
