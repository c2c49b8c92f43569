/* The estimator's whole cycle in virtual time: the machine of rt_world_shim.c, and a bus whose frames arrive when a
 * script says. Compiled by test_est_virtual_time.py against the built library. */
#include "rt_world_shim.c"

#include "est_cycle.h"
#include "est_settings.h"

typedef struct {
    int64_t at_ns;
    uint32_t id;
    uint32_t length;
    uint8_t data[8];
} arrival;

typedef struct {
    int64_t job;
    uint32_t id;
    uint32_t length;
    uint8_t data[8];
} departure;

typedef struct {
    world *world;
    outcome *out;         /* of the job that runs */
    const arrival *next;
    const arrival *end;
    int64_t job;
    int64_t sends;        /* of this job */
    bool computed;
    departure *sent;
    size_t sent_count;
    size_t sent_room;
    uint64_t dropped;
} bus;

enum { FRAMES_BEFORE_PUBLISHED = 5 }; /* Estimate, EstimateInnov, EstValidity, EstWinding, EstRotor */

static void bus_begin(void *ctx, int64_t now_ns) {
    (void)now_ns;
    bus *b = ctx;
    b->sends = 0;
    b->computed = false;
    b->out->start_ns = b->world->now_ns;
    b->out->start_cpu_ns = b->world->cpu_ns;
}

static est_io_status bus_recv(void *ctx, struct canfd_frame *frame, int64_t *at_ns) {
    bus *b = ctx;
    if (b->next < b->end && b->next->at_ns <= b->world->now_ns && !b->computed) {
        memset(frame, 0, sizeof *frame);
        frame->can_id = b->next->id;
        frame->len = (uint8_t)b->next->length;
        memcpy(frame->data, b->next->data, sizeof b->next->data);
        *at_ns = b->next->at_ns;
        b->next++;
        return EST_IO_OK;
    }
    if (!b->computed) { /* all is read: now it computes */
        move(b->world, b->world->step.away_ns, false);
        move(b->world, b->world->step.cpu_ns, true);
        b->out->stepped_ns = b->world->now_ns;
        b->out->stepped_cpu_ns = b->world->cpu_ns;
        b->computed = true;
    }
    return EST_IO_EMPTY;
}

static est_io_status bus_send(void *ctx, const struct canfd_frame *frame) {
    bus *b = ctx;
    const step *s = &b->world->step;
    const bool estimate = b->sends == 0;
    if (estimate) {
        move(b->world, s->publish_ns, true);
        run_canary(b->world);
        b->out->published_ns = b->world->now_ns;
    } else if (b->sends == FRAMES_BEFORE_PUBLISHED) {
        move(b->world, s->rest_ns, true);
        b->out->done_ns = b->world->now_ns;
    }
    b->sends++;
    if (estimate && s->sent == 0) {
        b->dropped++;
        return EST_IO_FULL;
    }
    if (b->sent_count == b->sent_room) {
        return EST_IO_GONE;
    }
    departure *d = &b->sent[b->sent_count++];
    d->job = b->job;
    d->id = frame->can_id;
    d->length = frame->len;
    memcpy(d->data, frame->data, sizeof d->data);
    return EST_IO_OK;
}

static void bus_counters(void *ctx, est_io_counters *out) {
    const bus *b = ctx;
    memset(out, 0, sizeof *out);
    out->sent = b->sent_count;
    out->tx_drops = b->dropped;
}

static est_cycle *cycle;
static est_cycle *fresh; /* after its set-up, which takes long */

/* Once. 0, or 1 when there is no such setting or memory. */
int est_world_open(const rt_task_config *config) {
    static const est_identity identity;
    const size_t size = (sizeof(est_cycle) + 63) / 64 * 64;
    const rt_clock clock = {NULL, world_now, world_cpu, world_sleep, world_core};
    const est_io io = {NULL, bus_begin, bus_recv, bus_send, bus_counters, NULL};
    cycle = aligned_alloc(64, size);
    fresh = aligned_alloc(64, size);
    if (cycle == NULL || fresh == NULL ||
        est_cycle_init(cycle, config, &clock, est_setting_find("default"), &io, &identity) != EST_CYCLE_OK) {
        return 1;
    }
    memcpy(fresh, cycle, sizeof *fresh);
    return 0;
}

/* Runs up to `n` jobs and sends the final counters. Returns how many ran, or -1 for a configuration it refused. */
int64_t est_world_run(const rt_task_config *config, est_on_miss on_miss, const machine *m, const theft *thefts, size_t theft_count,
                      const step *steps, size_t n, const arrival *arrivals, size_t arrival_count, outcome *out,
                      departure *sent, size_t *sent_count, rt_canary_record *heard, size_t *heard_count) {
    world *w = calloc(1, sizeof *w);
    const rt_clock clock = {w, world_now, world_cpu, world_sleep, world_core};
    bus b = {.world = w, .next = arrivals, .end = arrivals + arrival_count, .sent = sent, .sent_room = *sent_count};
    w->machine = m;
    w->now_ns = m->start_ns;
    w->thefts = thefts;
    w->theft_count = theft_count;
    w->t0_ns = w->canary_at_ns = config->t0_ns;
    w->period_ns = config->period_ns;
    w->heard = heard;
    w->heard_room = *heard_count;
    memcpy(cycle, fresh, sizeof *cycle);
    cycle->io.ctx = &b;
    est_cycle_on_miss(cycle, on_miss);
    int64_t ran = -1;
    if (rt_task_init(&cycle->task, config, &clock) == RT_TASK_OK) {
        if (m->canary != 0) {
            rt_task_set_canary(&cycle->task, &w->ring, m->canary == 2);
        }
        for (ran = 0; ran < (int64_t)n && !rt_task_stopped(&cycle->task); ran++) {
            est_cycle_status status = EST_CYCLE_INTERRUPTED;
            w->step = steps[ran];
            b.out = &out[ran];
            b.job = ran;
            while (status == EST_CYCLE_INTERRUPTED) {
                status = est_cycle_wait_and_run(cycle);
            }
            out[ran].broken = status != EST_CYCLE_OK || broken(&cycle->task);
        }
        b.sends = FRAMES_BEFORE_PUBLISHED + 1; /* counters only: no clock moves */
        b.job = -1;
        (void)est_cycle_send_final(cycle);
    }
    *sent_count = b.sent_count;
    end_canary(w);
    *heard_count = w->heard_count;
    free(w);
    return ran;
}
