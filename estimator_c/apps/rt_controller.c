/* The controller process: command line, set-up, loop, end. What a cycle does is in ctl_cycle. The sibling of
 * rt_estimator: the same real-time loop, the same records in lock-step and in replay. */
#include <errno.h>
#include <getopt.h>
#include <inttypes.h>
#include <signal.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "build_id.h"
#include "can_port.h"
#include "ctl_cycle.h"
#include "ctl_preview.h"
#include "ctl_report.h"
#include "est_lockstep.h"
#include "est_port.h"
#include "rt_canary.h"
#include "rt_clock.h"
#include "rt_grant.h"
#include "rt_machine.h"
#include "thermal_net.h"

enum { DEFAULT_PERIOD_US = 100000, DEFAULT_PRIORITY = 79, MAX_CORE = 1023 };
enum { MIN_WARMUP_RELEASES = 5, US_PER_S = 1000000 };

/* The value table of CtlBuild.controller_id. */
static const char *const controller_names[] = {"none", "rule-150-155", "rule-145-160", "mpc-S", "mpc-M", "paper"};
enum { CONTROLLERS = sizeof controller_names / sizeof controller_names[0] };

typedef struct {
    const char *bus;
    const char *preview;
    uint8_t controller; /* of controller_names */
    int64_t period_us;
    rt_request request;
    bool canary;
    bool lockstep;
    bool replay; /* lock-step where the records say which job ran when */
} options;

static const int64_t REPLAY_MAX_NS = INT64_C(1) << 61; /* 73 years to both sides: differences do not overflow */

/* All of the process's large state, out of the stack and locked with the rest. */
static ctl_cycle cycle;
static ctl_preview preview;
static est_lockstep lockstep;
static est_port port_state;
static rt_canary canary;
static rt_machine machine;
static can_port_t port;
static volatile sig_atomic_t stop_requested;

static void on_stop(int signal_number) {
    (void)signal_number;
    stop_requested = 1;
}

__attribute__((format(printf, 1, 2))) static int fail(const char *format, ...) {
    va_list args;
    va_start(args, format);
    (void)fputs("rt_controller: ", stderr);
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
    (void)fputs("usage: rt_controller --bus socketcan:IFACE|rt_hub:PATH --preview FILE [--controller NAME] [--core N]\n"
                "                     [--period-us 10000|20000|50000|100000] [--priority 1..99] [--no-rt] [--no-canary]\n"
                "       rt_controller --lockstep --preview FILE [--controller NAME] …   records on stdin and stdout\n"
                "       rt_controller --replay   --preview FILE [--controller NAME] …   they say when jobs ran\n"
                "controllers: none, rule-150-155, rule-145-160, mpc-S, mpc-M (default), paper\n",
                out);
}

static bool parse_number(const char *text, long low, long high, long *value) {
    char *end = NULL;
    errno = 0;
    *value = strtol(text, &end, 10);
    return errno == 0 && end != text && *end == '\0' && *value >= low && *value <= high;
}

static int find_controller(const char *name, uint8_t *found) {
    for (uint8_t i = 0; i < CONTROLLERS; i++) {
        if (strcmp(controller_names[i], name) == 0) {
            *found = i;
            return -1;
        }
    }
    return fail("--controller: none is called '%s'; choose none, rule-150-155, rule-145-160, mpc-S, mpc-M or paper",
                name);
}

static int parse_request(int choice, options *opt) {
    long number = 0;
    if (choice == 't') {
        if (!parse_number(optarg, 1, US_PER_S, &number) ||
            (number != 10000 && number != 20000 && number != 50000 && number != 100000)) {
            return fail("--period-us: '%s' is no period of the controller; give 10000, 20000, 50000 or 100000", optarg);
        }
        opt->period_us = number;
    } else if (choice == 'c') {
        if (!parse_number(optarg, 0, MAX_CORE, &number)) {
            return fail("--core: '%s' is not a core; give 0 to %d", optarg, MAX_CORE);
        }
        opt->request.core = (int)number;
    } else {
        if (!parse_number(optarg, 1, 99, &number)) {
            return fail("--priority: '%s' is not a SCHED_FIFO priority; give 1 to 99", optarg);
        }
        opt->request.priority = (int)number;
    }
    return -1;
}

static int check(options *opt, int argc, char **argv, const char *name) {
    if (optind < argc) {
        return fail("'%s' is no option; see rt_controller --help", argv[optind]);
    }
    if (opt->lockstep == (opt->bus != NULL)) {
        return fail("give either --bus socketcan:IFACE, --bus rt_hub:PATH, --lockstep or --replay; "
                    "see rt_controller --help");
    }
    if (opt->preview == NULL) {
        return fail("--preview FILE is needed: the road ahead, as python -m plant_sim.preview writes it");
    }
    if (opt->lockstep) {
        opt->request.real_time = false; /* it waits for its input, not for a clock */
        opt->canary = false;
    }
    return find_controller(name, &opt->controller);
}

/* -1: go on; otherwise the exit status. */
static int parse(int argc, char **argv, options *opt) {
    static const struct option table[] = {
        {"bus", required_argument, NULL, 'b'},       {"preview", required_argument, NULL, 'v'},
        {"controller", required_argument, NULL, 'k'}, {"period-us", required_argument, NULL, 't'},
        {"core", required_argument, NULL, 'c'},      {"priority", required_argument, NULL, 'p'},
        {"no-rt", no_argument, NULL, 'n'},
        {"canary", no_argument, NULL, 'C'},          {"no-canary", no_argument, NULL, 'N'},
        {"lockstep", no_argument, NULL, 'l'},
        {"replay", no_argument, NULL, 'r'},          {"help", no_argument, NULL, 'h'},
        {NULL, 0, NULL, 0},
    };
    const char *name = "mpc-M";
    int choice = 0, exit_status = -1;
    *opt = (options){.period_us = DEFAULT_PERIOD_US, .request = {-1, DEFAULT_PRIORITY, true}, .canary = true};
    opterr = 0;
    while (exit_status == -1 && (choice = getopt_long(argc, argv, "", table, NULL)) != -1) {
        switch (choice) {
        case 'b':
            opt->bus = optarg;
            break;
        case 'v':
            opt->preview = optarg;
            break;
        case 'k':
            name = optarg;
            break;
        case 't':
        case 'c':
        case 'p':
            exit_status = parse_request(choice, opt);
            break;
        case 'n':
            opt->request.real_time = false;
            break;
        case 'C':
        case 'N':
            opt->canary = choice == 'C';
            break;
        case 'r':
            opt->replay = true;
            opt->lockstep = true;
            break;
        case 'l':
            opt->lockstep = true;
            break;
        case 'h':
            usage(stdout);
            (void)fflush(stdout);
            return was_written("usage") ? EXIT_SUCCESS : EXIT_FAILURE;
        default:
            return fail("%s: unknown option or missing value; see rt_controller --help", argv[optind - 1]);
        }
    }
    return exit_status == -1 ? check(opt, argc, argv, name) : exit_status;
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

/* -1: go on; otherwise the exit status. */
static int set_up(const options *opt, const est_io *io, const rt_granted *granted) {
    const rt_clock clock = rt_clock_system();
    const ctl_identity identity = {
        .dbc_hash = DRIVE_DBC_HASH24,
        .weights_hash = net_weights_hash24,
        .build_hash = BUILD_HASH24,
        .preview_hash = preview.fingerprint,
        .controller_id = opt->controller,
        .policy = (uint8_t)granted->policy,
        .priority = granted->priority,
        .core = granted->core,
        .mlock = granted->mlock,
        .period_us = opt->period_us,
    };
    rt_task_config config = {
        .period_ns = opt->period_us * 1000,
        .deadline_ns = opt->period_us * 1000,
        .warmup_releases = (uint64_t)((US_PER_S + opt->period_us - 1) / opt->period_us),
        .virtual_time = opt->lockstep,
    };
    if (config.warmup_releases < MIN_WARMUP_RELEASES) {
        config.warmup_releases = MIN_WARMUP_RELEASES;
    }
    const char *name = controller_names[opt->controller];
    const ctl_cycle_status status = ctl_cycle_init(&cycle, &config, &clock, name, &preview.road, io, &identity);
    if (status == CTL_CYCLE_OK) {
        return -1;
    }
    if (status == CTL_CYCLE_BAD_CONTROLLER && cycle.error == CONTROLLER_NO_NET) {
        return fail("controller '%s' needs a net of one layer of LSTM cells; build with such weights", name);
    }
    return fail("controller '%s' does not fit this build (error %d); change estimator_c/settings/mpc and build again",
                name, (int)cycle.error);
}

static void report_ready(FILE *out, const options *opt, const rt_granted *granted) {
    const ctl_report_identity identity = {controller_names[opt->controller], net_weights_sha256, DRIVE_DBC_SHA256,
                                          BUILD_SHA256, preview.fingerprint, opt->period_us, granted};
    ctl_report_ready(out, &identity);
}

/* ---- real time ------------------------------------------------------------------------------------------------- */

static void listen_to_ours(void) {
    struct can_filter wanted[CTL_RX_COUNT];
    for (int i = 0; i < CTL_RX_COUNT; i++) {
        wanted[i].can_id = drive_messages[ctl_rx_index[i]].can_id;
        wanted[i].can_mask = CAN_SFF_MASK | CAN_EFF_FLAG | CAN_RTR_FLAG;
    }
    (void)can_port_filter(&port, wanted, CTL_RX_COUNT); /* without it the cycle ignores foreign ids itself */
}

static void start_helpers(const options *opt, rt_granted *granted) {
    if (opt->canary) {
        rt_canary_start(&canary, opt->period_us * 1000, granted);
    }
    if (canary.running) {
        rt_task_set_canary(&cycle.task, &canary.ring, canary.conclusive);
    }
    rt_machine_start(&machine, granted->core, (int64_t)US_PER_S * 1000);
    ctl_cycle_watch(&cycle, &machine);
}

static void stop_helpers(void) {
    rt_canary_stop(&canary);
    rt_machine_stop(&machine);
}

static int run_on_bus(const options *opt) {
    rt_granted granted;
    ctl_report_run run = {.stopped_by = "signal"};
    if (can_port_open(&port, opt->bus) != CAN_PORT_OK) {
        return fail("%s", port.error);
    }
    const est_io io = est_port_io(&port_state, &port);
    if (!port.hub) {
        listen_to_ours();
    }
    rt_grant_apply(&opt->request, &granted);
    const int refused = set_up(opt, &io, &granted);
    if (refused != -1) {
        can_port_close(&port);
        return refused;
    }
    start_helpers(opt, &granted);
    report_ready(stdout, opt, &granted);
    if (!was_written("ready")) {
        stop_helpers();
        can_port_close(&port);
        return EXIT_FAILURE;
    }
    rt_environment_read(&run.start, true);
    ctl_cycle_start_grid(&cycle);
    if (canary.running) {
        rt_canary_aim(&canary, cycle.task.config.t0_ns);
    }

    ctl_cycle_status status = CTL_CYCLE_OK;
    while (stop_requested == 0 && status != CTL_CYCLE_GONE) {
        status = ctl_cycle_wait_and_run(&cycle);
        if (!run.warm_valid && cycle.task.last_index >= cycle.task.config.warmup_releases) {
            rt_environment_read(&run.warm, false);
            run.warm_valid = true;
        }
    }

    stop_helpers(); /* before the figures: nobody writes what they are made of */
    rt_environment_read(&run.end, true);
    if (status != CTL_CYCLE_GONE) {
        status = ctl_cycle_send_final(&cycle);
    }
    if (status == CTL_CYCLE_GONE) {
        run.stopped_by = "bus";
    }
    ctl_report_final(stdout, &cycle, &run);
    const int exit_status = status == CTL_CYCLE_GONE ? fail("%s", port.error)
                            : was_written("final")   ? EXIT_SUCCESS
                                                     : EXIT_FAILURE;
    can_port_close(&port);
    return exit_status;
}

/* ---- lock-step and replay -------------------------------------------------------------------------------------- */

/* Runs the jobs released before `until_ns` (`inclusive`: at it, too). */
static ctl_cycle_status run_releases(int64_t until_ns, bool inclusive) {
    ctl_cycle_status status = CTL_CYCLE_OK;
    while (status == CTL_CYCLE_OK) {
        const int64_t release_ns = rt_task_next_release_ns(&cycle.task);
        if (release_ns > until_ns || (release_ns == until_ns && !inclusive)) {
            break;
        }
        status = ctl_cycle_run_released(&cycle);
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
        return sane ? -1
                    : fail("stdin: record time %lld ns; give times since the grid's start", (long long)record->t_ns);
    }
    if (est_lockstep_advance(&lockstep, record->t_ns) != EST_LOCKSTEP_OK) {
        return fail("stdin: record time from %lld to %lld ns; records must come in order of time, without leaps",
                    (long long)lockstep.last_ns, (long long)record->t_ns);
    }
    return run_releases(record->t_ns, tick) == CTL_CYCLE_OK ? -1 : reader_left();
}

static int replay_job(const rt_record *record) {
    const uint8_t *bytes = record->frame.data;
    const uint32_t index =
        (uint32_t)bytes[1] | (uint32_t)bytes[2] << 8 | (uint32_t)bytes[3] << 16 | (uint32_t)bytes[4] << 24;
    if (index <= cycle.task.last_index) {
        return fail("stdin: release %lu comes after release %lu; jobs are replayed in their order",
                    (unsigned long)index, (unsigned long)cycle.task.last_index);
    }
    return ctl_cycle_run_replayed(&cycle, index, record->t_ns) == CTL_CYCLE_OK ? -1 : reader_left();
}

/* Handles one record. *done at END. Returns an exit status, or -1 to go on. */
static int handle(const options *opt, const est_io *io, const rt_record *record, bool *done) {
    const bool control = record->frame.can_id == RT_RECORD_CONTROL_ID;
    const uint8_t code = record->frame.data[0];
    const int exit_status = pass_time(opt, record, control && code == RT_RECORD_TICK);
    if (exit_status != -1) {
        return exit_status;
    }
    if (control && code == RT_RECORD_JOB && opt->replay) {
        return replay_job(record);
    }
    if (!control || (code != RT_RECORD_TICK && code != RT_RECORD_END)) {
        est_lockstep_push(&lockstep, record);
        return -1;
    }
    ctl_cycle_status status = CTL_CYCLE_OK;
    if (code == RT_RECORD_END) {
        io->begin(io->ctx, record->t_ns);
        status = ctl_cycle_send_final(&cycle);
        *done = true;
    }
    const bool answered = rt_record_control(&lockstep.writer, record->t_ns, code) == RT_RECORD_OK;
    return status == CTL_CYCLE_OK && answered ? -1 : reader_left();
}

static int run_lockstep(const options *opt) {
    rt_granted granted;
    ctl_report_run run = {.stopped_by = "end"};
    est_lockstep_init(&lockstep, STDIN_FILENO, STDOUT_FILENO);
    const est_io io = est_lockstep_io(&lockstep);
    rt_grant_apply(&opt->request, &granted);
    int exit_status = set_up(opt, &io, &granted);
    if (exit_status != -1) {
        return exit_status;
    }
    report_ready(stderr, opt, &granted);
    rt_environment_read(&run.start, true);
    bool done = false;
    while (exit_status == -1 && !done) {
        rt_record record;
        const rt_record_status status = rt_record_read(&lockstep.reader, &record);
        exit_status = status == RT_RECORD_OK ? handle(opt, &io, &record, &done) : bad_input(status);
    }
    rt_environment_read(&run.end, true);
    if (exit_status != -1) {
        run.stopped_by = "input";
        (void)rt_record_flush(&lockstep.writer); /* what was published before the mistake */
    }
    ctl_report_final(stderr, &cycle, &run);
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
    const ctl_preview_status status = ctl_preview_load(&preview, opt.preview);
    if (status != CTL_PREVIEW_OK) {
        return fail("--preview %s: %s", opt.preview, preview.error);
    }
    return opt.lockstep ? run_lockstep(&opt) : run_on_bus(&opt);
}
