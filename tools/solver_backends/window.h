/* The MHE's window in its plainest form, kept by following the stream: what the problem is, without any solver.
 * Nodes are in a straight array, oldest first. */
#ifndef WINDOW_H
#define WINDOW_H

#include <stdbool.h>
#include <string.h>

#include "stream.h"
#include "thermal_net.h"

enum { WINDOW_NODES = 16, WINDOW_PROBLEM = 16 + NET_MEMORY + 6 * WINDOW_NODES };

typedef struct {
    double theta[2];
    double u[2];
    double w[2]; /* process noise of the stage that leaves this node */
    double y[2];
    double weight[2];
    double memory[NET_MEMORY];
} window_node_t;

typedef struct {
    double setting[STREAM_SETTING];
    window_node_t node[WINDOW_NODES];
    int count;
    bool full;
    double prior[2];
    double arrival[2];
} window_t;

static inline double window_weight(const window_t *self, int k, int ch)
{
    const bool counted = self->setting[SETTING_NEWEST] != 0.0 || k + 1 < self->count;
    return counted ? self->node[k].weight[ch] : 0.0;
}

static inline const double *window_arrival(const window_t *self)
{
    return self->full ? self->arrival : &self->setting[SETTING_PRIOR];
}

/* Make room for a node and give the stage that leads to it its input. */
static inline window_node_t *window_append(window_t *self, const double u[])
{
    if (self->count == WINDOW_NODES) {
        memmove(&self->node[0], &self->node[1], (WINDOW_NODES - 1) * sizeof self->node[0]);
        self->count--;
        self->full = true;
        memcpy(self->prior, self->node[0].theta, sizeof self->prior);
    }
    memcpy(self->node[self->count - 1].u, u, 2 * sizeof u[0]);
    memset(self->node[self->count - 1].w, 0, sizeof self->node[0].w);
    window_node_t *newest = &self->node[self->count++];
    memset(newest, 0, sizeof *newest);
    return newest;
}

/* Every record but STREAM_ADVANCE and STREAM_SOLVE. */
static inline void window_call(window_t *self, const double record[])
{
    const double *at = record + 2;
    switch ((int)record[0]) {
    case STREAM_INIT:
        memset(self, 0, sizeof *self);
        memcpy(self->setting, at, sizeof self->setting);
        memcpy(self->arrival, &at[SETTING_ARRIVAL], sizeof self->arrival);
        break;
    case STREAM_START:
        self->count = 1;
        self->full = false;
        memset(&self->node[0], 0, sizeof self->node[0]);
        memcpy(self->node[0].theta, at, sizeof self->prior);
        memcpy(self->prior, at, sizeof self->prior);
        memcpy(self->node[0].memory, at + 2, sizeof self->node[0].memory);
        break;
    case STREAM_ARRIVAL:
        memcpy(self->prior, at, sizeof self->prior);
        memcpy(self->arrival, at + 2, sizeof self->arrival);
        if (record[1] > 4.0) {
            memcpy(self->node[0].memory, at + 4, sizeof self->node[0].memory);
        }
        break;
    case STREAM_MEASURE: {
        const int k = self->count - 1 - (int)at[0];
        const int ch = (int)at[1];
        if (k >= 0 && at[2] == at[2] && at[2] - at[2] == 0.0) { /* finite */
            self->node[k].y[ch] = at[2];
            self->node[k].weight[ch] = at[3] * self->setting[SETTING_MEASUREMENT + ch];
        }
        break;
    }
    case STREAM_FORGET:
        for (int k = self->count - 1; k >= 0 && k >= self->count - (int)at[1]; k--) {
            self->node[k].weight[(int)at[0]] = 0.0;
        }
        break;
    case STREAM_SHIFT:
        for (int k = 0; k < self->count; k++) {
            self->node[k].theta[(int)at[0]] += at[1];
        }
        self->prior[(int)at[0]] += at[1];
        break;
    case STREAM_WEIGH:
        memcpy(&self->setting[SETTING_NOISE], at, 2 * sizeof *at);
        self->setting[SETTING_LOSS_SCALE] = at[2];
        break;
    default:
        break;
    }
}

/* The problem as doubles: count, loss, scale, hard, lower, upper, bound weight, 0, prior[2], arrival weight[2], noise weight[2],
 * 0, 0, memory of node 0, then u, y and weight of WINDOW_NODES nodes. Returns WINDOW_PROBLEM. */
static inline int window_problem(const window_t *self, double out[])
{
    const double *s = self->setting;
    const double head[16] = {
        self->count, s[SETTING_LOSS], s[SETTING_LOSS_SCALE], s[SETTING_HARD], s[SETTING_LOWER], s[SETTING_UPPER],
        s[SETTING_BOUND_WEIGHT], 0.0, self->prior[0], self->prior[1], window_arrival(self)[0], window_arrival(self)[1],
        s[SETTING_NOISE], s[SETTING_NOISE + 1], 0.0, 0.0,
    };
    memcpy(out, head, sizeof head);
    memcpy(out + 16, self->node[0].memory, sizeof self->node[0].memory);
    double *rest = out + 16 + NET_MEMORY;
    memset(rest, 0, 6 * WINDOW_NODES * sizeof *rest);
    for (int k = 0; k < self->count; k++) {
        for (int ch = 0; ch < 2; ch++) {
            rest[2 * k + ch] = self->node[k].u[ch];
            rest[2 * WINDOW_NODES + 2 * k + ch] = self->node[k].y[ch];
            rest[4 * WINDOW_NODES + 2 * k + ch] = window_weight(self, k, ch);
        }
    }
    return WINDOW_PROBLEM;
}

#endif
