/* The estimator process: command line, set-up, loop, end. What a cycle does is in est_cycle. */
#include <errno.h>
#include <getopt.h>
#include <signal.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "build_id.h"
#include "can_port.h"
#include "est_cycle.h"
#include "est_lockstep.h"
#include "est_port.h"
#include "est_report.h"
#include "thermal_net.h"
#include "rt_clock.h"
#include "rt_canary.h"
#include "rt_grant.h"
#include "rt_machine.h"
#include "rt_reaction.h"

enum { MIN_PERIOD_US = 1000, MAX_PERIOD_US = 1000000, DEFAULT_PERIOD_US = 100000, DEFAULT_PRIORITY = 80, MAX_CORE = 1023 };
enum { MIN_WARMUP_RELEASES = 5, US_PER_S = 1000000, MAX_GRACE = 1000000 };
static const int64_t FLUSH_NS = INT64_C(8000000000); /* the supervisor gives us twelve seconds to end */

enum { EXIT_TIMING = 2 }; /* the policy stopped it: too many misses */

typedef struct {
    const char *bus;
    const est_setting_t *setting;
    int64_t period_us;
    int64_t deadline_us;     /* 0: the period */
    rt_request request;
    rt_reaction reaction;
    est_on_miss on_miss;
    uint32_t mk_m;
    uint32_t mk_k;
    int64_t grace_releases;  /* -1: a second, at least MIN_WARMUP_RELEASES */
    injections faults;
    bool canary;
    bool on_frame;
    bool lockstep;
    bool replay; /* lock-step where the records say which job ran when */
} options;

static const int64_t REPLAY_MAX_NS = INT64_C(1) << 61; /* 73 years to both sides: differences do not overflow */

/* All of the process's large state, out of the stack and locked with the rest. */
static est_cycle cycle;
static est_lockstep lockstep;
static est_port port_state;
static can_port_t port;
static rt_stats scratch;
static rt_canary canary;
static rt_machine machine;
static volatile sig_atomic_t stop_requested;

static void on_stop(int signal_number) {
    (void)signal_number;
    stop_requested = 1;
}

__attribute__((format(printf, 1, 2))) static int fail(const char *format, ...) {
    va_list args;
    va_start(args, format);
    (void)fputs("rt_estimator: ", stderr);
    (void)vfprintf(stderr, format, args);
    (void)fputc('\n', stderr);
    va_end(args);
    return EXIT_FAILURE;
}

/* False when what was just written did not get out; stderr then says so. */
static bool was_written(const char *what) {
    if (ferror(stdout) == 0) {
        return true;
    }
    (void)fail("stdout: cannot write the %s line (%s); give it a place to go", what, strerror(errno));
    return false;
}

static void usage(FILE *out) {
    (void)fputs("usage: rt_estimator --bus socketcan:IFACE|rt_hub:PATH [--setting NAME] [--period-us 1000..1000000]\n"
                "                    [--deadline-us 1..period]\n"
                "                    [--core N] [--priority 1..99] [--no-rt] [--no-canary]\n"
                "                    [--trigger time|frame] [--policy skip|queue:N|rebase|cut:US|stop:total:M|stop:row:M]\n"
                "                    [--on-miss late|hold|predict|invalid] [--grace-releases N] [--mk M,K]\n"
                "                    [--inject compute:US@RELEASE|sleep:US@RELEASE] …\n"
                "       rt_estimator --lockstep [--setting NAME] [--period-us …]   records on stdin and stdout\n"
                "       rt_estimator --replay [--setting NAME] [--period-us …]     the same, and they say when each job ran\n",
                out);
}

static bool parse_number(const char *text, long low, long high, long *value) {
    char *end = NULL;
    errno = 0;
    *value = strtol(text, &end, 10);
    return errno == 0 && end != text && *end == '\0' && *value >= low && *value <= high;
}

static int bad_setting(const char *name) {
    char known[256] = "";
    for (size_t i = 0; i < EST_SETTINGS_COUNT; i++) {
        (void)strncat(known, i > 0 ? ", " : "", sizeof known - strlen(known) - 1);
        (void)strncat(known, est_settings[i].name, sizeof known - strlen(known) - 1);
    }
    return fail("--setting: no setting is called '%s'; compiled in are: %s", name, known);
}

static bool parse_name(const char *text, const char *const *names, int count, int *value) {
    for (int i = 0; i < count; i++) {
        if (strcmp(text, names[i]) == 0) {
            *value = i;
            return true;
        }
    }
    return false;
}

/* The options of what happens when time runs out. -1: go on; otherwise the exit status. */
static int parse_timing(options *opt, int choice, const char *text) {
    static const char *const reactions[] = {"late", "hold", "predict", "invalid"};
    static const char *const triggers[] = {"time", "frame"};
    long number = 0;
    int which = 0;
    switch (choice) {
    case 'P':
        return rt_reaction_parse(text, &opt->reaction)
                   ? -1
                   : fail("--policy: '%s' is none of skip, queue:N (N 1 to %d), rebase, cut:BUDGET_US, stop:total:M, stop:row:M",
                          text, RT_QUEUE_MAX);
    case 'o':
        if (!parse_name(text, reactions, 4, &which)) {
            return fail("--on-miss: '%s' is none of late, hold, predict, invalid", text);
        }
        opt->on_miss = (est_on_miss)which;
        return -1;
    case 'g':
        if (!parse_number(text, 0, MAX_GRACE, &number)) {
            return fail("--grace-releases: '%s' is no number of releases; give 0 to %d", text, MAX_GRACE);
        }
        opt->grace_releases = number;
        return -1;
    case 'm':
        return rt_mk_parse(text, &opt->mk_m, &opt->mk_k)
                   ? -1
                   : fail("--mk: '%s' is not M,K: at most M misses in any K releases, 0 <= M < K <= %d", text, RT_MK_WINDOW);
    case 'i':
        return injections_add(&opt->faults, text)
                   ? -1
                   : fail("--inject: '%s' is neither compute:US@RELEASE nor sleep:US@RELEASE (US 1 to %d), or one more than %d", text,
                          INJECTION_MAX_US, INJECTIONS_MAX);
    case 'T':
    default:
        if (!parse_name(text, triggers, 2, &which)) {
            return fail("--trigger: '%s' is neither time nor frame", text);
        }
        opt->on_frame = which == 1;
        return -1;
    }
}

/* What does not go together. -1: go on; otherwise the exit status. */
static int check(options *opt) {
    if (opt->lockstep == (opt->bus != NULL)) {
        return fail("give either --bus socketcan:IFACE, --bus rt_hub:PATH, --lockstep or --replay; see rt_estimator --help");
    }
    if (opt->deadline_us > opt->period_us) {
        return fail("--deadline-us: a deadline of %lld us lies behind the period of %lld us; give at most the period",
                    (long long)opt->deadline_us, (long long)opt->period_us);
    }
    opt->deadline_us = opt->deadline_us > 0 ? opt->deadline_us : opt->period_us;
    if (!rt_reaction_valid(&opt->reaction, opt->deadline_us * 1000)) {
        return fail("--policy: a cut budget must not be longer than the deadline of %lld us (the period, unless told)",
                    (long long)opt->deadline_us);
    }
    if (opt->on_frame && opt->reaction.overrun != RT_OVERRUN_SKIP) {
        return fail("--policy: queue and rebase are for the time grid; with --trigger frame give skip, cut or stop");
    }
    if (opt->lockstep && (opt->on_frame || opt->faults.count > 0)) {
        return fail("--lockstep: there is no time in lock-step, so no --trigger frame and no --inject");
    }
    if (opt->lockstep) {
        opt->request.real_time = false; /* it waits for its input, not for a clock */
        opt->canary = false;
    }
    return -1;
}

/* -1: go on; otherwise the exit status. */
static int parse(int argc, char **argv, options *opt) {
    static const struct option table[] = {
        {"bus", required_argument, NULL, 'b'},      {"setting", required_argument, NULL, 's'},
        {"deadline-us", required_argument, NULL, 'd'},
        {"period-us", required_argument, NULL, 't'}, {"core", required_argument, NULL, 'c'},
        {"priority", required_argument, NULL, 'p'},  {"no-rt", no_argument, NULL, 'n'},
        {"lockstep", no_argument, NULL, 'l'},        {"help", no_argument, NULL, 'h'},
        {"policy", required_argument, NULL, 'P'},    {"on-miss", required_argument, NULL, 'o'},
        {"mk", required_argument, NULL, 'm'},        {"grace-releases", required_argument, NULL, 'g'},
        {"inject", required_argument, NULL, 'i'},    {"trigger", required_argument, NULL, 'T'},
        {"canary", no_argument, NULL, 'C'},          {"no-canary", no_argument, NULL, 'N'},
        {"replay", no_argument, NULL, 'r'},
        {NULL, 0, NULL, 0},
    };
    const char *setting = "default";
    long number = 0;
    int choice = 0;
    *opt = (options){.period_us = DEFAULT_PERIOD_US, .request = {-1, DEFAULT_PRIORITY, true}, .grace_releases = -1, .canary = true};
    opterr = 0;
    while ((choice = getopt_long(argc, argv, "", table, NULL)) != -1) {
        switch (choice) {
        case 'b':
            opt->bus = optarg;
            break;
        case 's':
            setting = optarg;
            break;
        case 't':
            if (!parse_number(optarg, MIN_PERIOD_US, MAX_PERIOD_US, &number)) {
                return fail("--period-us: '%s' is not a period; give %d to %d (1 ms to 1 s)", optarg, MIN_PERIOD_US,
                            MAX_PERIOD_US);
            }
            opt->period_us = number;
            break;
        case 'd':
            if (!parse_number(optarg, 1, MAX_PERIOD_US, &number)) {
                return fail("--deadline-us: '%s' is not a deadline; give 1 to the period", optarg);
            }
            opt->deadline_us = number;
            break;
        case 'c':
            if (!parse_number(optarg, 0, MAX_CORE, &number)) {
                return fail("--core: '%s' is not a core; give 0 to %d", optarg, MAX_CORE);
            }
            opt->request.core = (int)number;
            break;
        case 'p':
            if (!parse_number(optarg, 1, 99, &number)) {
                return fail("--priority: '%s' is not a SCHED_FIFO priority; give 1 to 99", optarg);
            }
            opt->request.priority = (int)number;
            break;
        case 'n':
            opt->request.real_time = false;
            break;
        case 'l':
            opt->lockstep = true;
            break;
        case 'r':
            opt->lockstep = true;
            opt->replay = true;
            break;
        case 'C':
            opt->canary = true;
            break;
        case 'N':
            opt->canary = false;
            break;
        case 'P':
        case 'o':
        case 'm':
        case 'g':
        case 'i':
        case 'T': {
            const int bad = parse_timing(opt, choice, optarg);
            if (bad != -1) {
                return bad;
            }
            break;
        }
        case 'h':
            usage(stdout);
            (void)fflush(stdout);
            return was_written("usage") ? EXIT_SUCCESS : EXIT_FAILURE;
        default:
            return fail("%s: unknown option or missing value; see rt_estimator --help", argv[optind - 1]);
        }
    }
    if (optind < argc) {
        return fail("'%s' is no option; see rt_estimator --help", argv[optind]);
    }
    opt->setting = est_setting_find(setting);
    if (opt->setting == NULL) {
        return bad_setting(setting);
    }
    return check(opt);
}

static void catch_signals(const options *opt) {
    struct sigaction ignore;
    memset(&ignore, 0, sizeof ignore);
    ignore.sa_handler = SIG_IGN;
    (void)sigaction(SIGPIPE, &ignore, NULL); /* a reader that left is an error of write, not our death */
    if (opt->lockstep) {
        return; /* nothing on a bus to leave in good order: a signal ends the process at once */
    }
    struct sigaction stop;
    memset(&stop, 0, sizeof stop);
    stop.sa_handler = on_stop; /* no SA_RESTART: the sleep must end */
    (void)sigaction(SIGTERM, &stop, NULL);
    (void)sigaction(SIGINT, &stop, NULL);
}

static est_identity identity_of(const options *opt, const rt_granted *granted) {
    const est_identity identity = {
        .dbc_hash = DRIVE_DBC_HASH24,
        .weights_hash = net_weights_hash24,
        .build_hash = BUILD_HASH24,
        .setting_id = (uint8_t)opt->setting->id,
        .policy = (uint8_t)granted->policy,
        .priority = granted->priority,
        .core = granted->core,
        .mlock = granted->mlock,
        .period_us = opt->period_us,
    };
    return identity;
}

static est_cycle_status set_up(const options *opt, const est_io *io, const rt_granted *granted) {
    const rt_clock clock = rt_clock_system();
    const est_identity identity = identity_of(opt, granted);
    rt_task_config config = {
        .period_ns = opt->period_us * 1000,
        .deadline_ns = opt->deadline_us * 1000,
        .t0_ns = 0,
        .warmup_releases = (uint64_t)((US_PER_S + opt->period_us - 1) / opt->period_us),
        .virtual_time = opt->lockstep,
        .on_event = opt->on_frame,
        .reaction = opt->reaction,
        .mk_m = opt->mk_m,
        .mk_k = opt->mk_k,
    };
    if (config.warmup_releases < MIN_WARMUP_RELEASES) {
        config.warmup_releases = MIN_WARMUP_RELEASES;
    }
    if (opt->grace_releases >= 0) {
        config.warmup_releases = (uint64_t)opt->grace_releases;
    }
    const est_cycle_status status = est_cycle_init(&cycle, &config, &clock, opt->setting, io, &identity);
    if (status == EST_CYCLE_OK) {
        est_cycle_on_miss(&cycle, opt->on_miss);
        est_cycle_inject(&cycle, &opt->faults);
    }
    return status;
}

static const char *canary_of(void) {
    return !canary.running ? "none" : canary.conclusive ? "conclusive" : "shown";
}

static void report_ready(FILE *out, const options *opt, const rt_granted *granted) {
    const est_report_identity identity = {opt->setting->name, net_weights_sha256, DRIVE_DBC_SHA256,
                                          BUILD_SHA256,       opt->period_us,      canary_of(),        granted};
    est_report_ready(out, &identity);
}

/* ---- real time ---------------------------------------------------------------------------------------------------- */

static void start_helpers(const options *opt, rt_granted *granted) {
    if (opt->canary) {
        rt_canary_start(&canary, opt->period_us * 1000, granted);
    }
    if (canary.running) {
        rt_task_set_canary(&cycle.task, &canary.ring, canary.conclusive);
    }
    rt_machine_start(&machine, granted->core, (int64_t)US_PER_S * 1000);
    est_cycle_watch(&cycle, &machine);
}

static void stop_helpers(void) {
    rt_canary_stop(&canary);
    rt_machine_stop(&machine);
}

/* The loop, until a signal, the end of the bus or too many misses. */
static est_cycle_status loop(est_report_run *run) {
    est_cycle_status status = EST_CYCLE_OK;
    rt_environment_read(&run->start, true);
    est_cycle_start_grid(&cycle);
    if (canary.running) {
        rt_canary_aim(&canary, cycle.task.config.t0_ns);
    }
    while (stop_requested == 0 && status != EST_CYCLE_GONE && status != EST_CYCLE_STOPPED) {
        status = est_cycle_wait_and_run(&cycle);
        if (!run->warm_valid && cycle.task.last_index >= cycle.task.config.warmup_releases) {
            rt_environment_read(&run->warm, false);
            run->warm_valid = true;
        }
    }
    return status;
}

/* The counters once more, the figures, and how it ended. */
static int conclude(est_report_run *run, est_cycle_status status) {
    const bool stopped = status == EST_CYCLE_STOPPED;
    if (status != EST_CYCLE_GONE) {
        status = est_cycle_send_final(&cycle);
    }
    if (status == EST_CYCLE_OK) {
        (void)est_port_flush(&port_state, FLUSH_NS); /* in vain where nobody reads: then the log shows what is missing */
    }
    rt_environment_read(&run->end, true);
    run->stopped_by = status == EST_CYCLE_GONE ? "bus" : stopped ? "misses" : run->stopped_by;
    est_report_final(stdout, &cycle, run, &scratch);
    if (status == EST_CYCLE_GONE) {
        return fail("%s", port.error);
    }
    if (!was_written("final")) {
        return EXIT_FAILURE;
    }
    if (stopped) {
        (void)fail("stopped by its policy: %llu late and %llu skipped releases after warm-up, %llu misses in a row at most",
                   (unsigned long long)cycle.task.judged.miss_late, (unsigned long long)cycle.task.judged.miss_skipped,
                   (unsigned long long)cycle.task.judged.consec_miss_max);
    }
    return stopped ? EXIT_TIMING : EXIT_SUCCESS;
}

static int run_on_bus(const options *opt) {
    rt_granted granted;
    est_report_run run = {.stopped_by = "signal"};
    if (can_port_open(&port, opt->bus) != CAN_PORT_OK) {
        return fail("%s", port.error);
    }
    const est_io io = est_port_io(&port_state, &port);
    rt_grant_apply(&opt->request, &granted);
    if (est_port_short_of(&port_state, opt->period_us) > 0) {
        rt_grant_warn(&granted, "send buffer of %d bytes granted, %d short of a second of frames: needs CAP_NET_ADMIN or a larger "
                      "net.core.wmem_max; frames are lost when the hub is held up",
                      port_state.send_buffer_bytes, est_port_short_of(&port_state, opt->period_us));
    }
    if (set_up(opt, &io, &granted) != EST_CYCLE_OK) {
        can_port_close(&port);
        return fail("setting '%s' does not fit this build; change estimator_c/settings and build again", opt->setting->name);
    }
    start_helpers(opt, &granted);
    report_ready(stdout, opt, &granted);
    int exit_status = EXIT_FAILURE;
    if (was_written("ready")) {
        const est_cycle_status status = loop(&run);
        stop_helpers(); /* before the figures: nobody writes what they are made of */
        exit_status = conclude(&run, status);
    } else {
        stop_helpers();
    }
    can_port_close(&port);
    return exit_status;
}

/* ---- lock-step ------------------------------------------------------------------------------------------------------ */

/* Runs the jobs released before `until_ns` (`inclusive`: at it, too). */
static est_cycle_status run_releases(int64_t until_ns, bool inclusive) {
    est_cycle_status status = EST_CYCLE_OK;
    while (status == EST_CYCLE_OK) {
        const int64_t release_ns = rt_task_next_release_ns(&cycle.task);
        if (release_ns > until_ns || (release_ns == until_ns && !inclusive)) {
            break;
        }
        status = est_cycle_run_released(&cycle);
    }
    return status;
}

static int bad_input(rt_record_status status) {
    if (status == RT_RECORD_ERROR) {
        return fail("stdin: %s; lock-step records are read from it", strerror(errno));
    }
    return fail("stdin: the input ended %s an END record; the program that feeds it has stopped",
                status == RT_RECORD_TRUNCATED ? "inside a record, before" : "without");
}

static int reader_left(void) {
    return fail("stdout: %s; the program that reads it has stopped", strerror(errno));
}

/* The releases before the record's time, as far as they are not named by the records themselves. -1: go on. */
static int pass_time(const options *opt, const rt_record *record, bool tick) {
    if (opt->replay) { /* frames carry the time they arrived at, jobs the time they ran: their order is the log's */
        const bool sane = record->t_ns > -REPLAY_MAX_NS && record->t_ns < REPLAY_MAX_NS;
        return sane ? -1 : fail("stdin: record time %lld ns; give times since the start of the grid", (long long)record->t_ns);
    }
    const est_lockstep_status time = est_lockstep_advance(&lockstep, record->t_ns);
    if (time != EST_LOCKSTEP_OK) {
        return fail("stdin: record time %s from %lld to %lld ns; records must come in order of time",
                    time == EST_LOCKSTEP_JUMP ? "leaps" : "goes back", (long long)lockstep.last_ns, (long long)record->t_ns);
    }
    return run_releases(record->t_ns, tick) == EST_CYCLE_OK ? -1 : reader_left();
}

static int replay_job(const rt_record *record) {
    const uint8_t *bytes = record->frame.data;
    const uint32_t index = (uint32_t)bytes[1] | (uint32_t)bytes[2] << 8 | (uint32_t)bytes[3] << 16 | (uint32_t)bytes[4] << 24;
    if (index <= cycle.task.last_index) {
        return fail("stdin: release %lu comes after release %lu; jobs are replayed in their order", (unsigned long)index,
                    (unsigned long)cycle.task.last_index);
    }
    const est_replayed as = {(timing_output)bytes[5], bytes[6]};
    if (bytes[5] > TIMING_OUTPUT_INVALID) {
        return fail("stdin: release %lu put out %u; give 0 to %d, as the signal output", (unsigned long)index,
                    (unsigned)bytes[5], TIMING_OUTPUT_INVALID);
    }
    return est_cycle_run_replayed(&cycle, index, record->t_ns, &as) == EST_CYCLE_OK ? -1 : reader_left();
}

/* Handles one record. *done at END. Returns an exit status, or -1 to go on. */
static int handle(const options *opt, const est_io *io, const rt_record *record, bool *done) {
    const bool control = record->frame.can_id == RT_RECORD_CONTROL_ID;
    const uint8_t code = record->frame.data[0];
    est_cycle_status status = EST_CYCLE_OK;
    const int exit_status = pass_time(opt, record, control && code == RT_RECORD_TICK);
    if (exit_status != -1) {
        return exit_status;
    }
    if (control && code == RT_RECORD_JOB && opt->replay) {
        return replay_job(record);
    }
    if (control && (code == RT_RECORD_TICK || code == RT_RECORD_END)) {
        if (code == RT_RECORD_END) {
            io->begin(io->ctx, record->t_ns);
            status = est_cycle_send_final(&cycle);
            *done = true;
        }
        if (rt_record_control(&lockstep.writer, record->t_ns, code) != RT_RECORD_OK) {
            status = EST_CYCLE_GONE;
        }
    } else {
        est_lockstep_push(&lockstep, record);
    }
    return status == EST_CYCLE_OK ? -1 : reader_left();
}

static int run_lockstep(const options *opt) {
    rt_granted granted;
    est_report_run run = {.stopped_by = "end"};
    est_lockstep_init(&lockstep, STDIN_FILENO, STDOUT_FILENO);
    const est_io io = est_lockstep_io(&lockstep);
    rt_grant_apply(&opt->request, &granted);
    if (set_up(opt, &io, &granted) != EST_CYCLE_OK) {
        return fail("setting '%s' does not fit this build; change estimator_c/settings and build again", opt->setting->name);
    }
    report_ready(stderr, opt, &granted);
    rt_environment_read(&run.start, true);

    int exit_status = -1;
    bool done = false;
    while (exit_status == -1 && !done) {
        rt_record record;
        const rt_record_status status = rt_record_read(&lockstep.reader, &record);
        exit_status = status == RT_RECORD_OK ? handle(opt, &io, &record, &done) : bad_input(status);
        if (!run.warm_valid && cycle.task.last_index >= cycle.task.config.warmup_releases) {
            rt_environment_read(&run.warm, false);
            run.warm_valid = true;
        }
    }
    rt_environment_read(&run.end, true);
    if (exit_status != -1) {
        run.stopped_by = "input";
        (void)rt_record_flush(&lockstep.writer); /* what was published before the mistake; the exit status tells of that */
    }
    est_report_final(stderr, &cycle, &run, &scratch);
    if (ferror(stderr) != 0) {
        return EXIT_FAILURE; /* and no place to say so */
    }
    return exit_status == -1 ? EXIT_SUCCESS : exit_status;
}

int main(int argc, char **argv) {
    options opt;
    const int exit_status = parse(argc, argv, &opt);
    if (exit_status != -1) {
        return exit_status;
    }
    catch_signals(&opt);
    return opt.lockstep ? run_lockstep(&opt) : run_on_bus(&opt);
}
