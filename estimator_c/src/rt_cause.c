#include "rt_cause.h"

const char *const rt_cause_name[RT_CAUSES] = {
    "none", "late_wake", "preempted", "long_compute", "stale_input", "blocked_send", "steal",
};

rt_cause rt_cause_largest(const rt_delay *delay) {
    const struct {
        int64_t ns;
        rt_cause cause;
    } part[] = {
        {delay->backlog_ns, delay->backlog_cause},    {delay->wake_ns, RT_CAUSE_LATE_WAKE},
        {delay->away_ns, RT_CAUSE_PREEMPTED},         {delay->compute_ns, RT_CAUSE_LONG_COMPUTE},
        {delay->send_ns, RT_CAUSE_BLOCKED_SEND},
    };
    unsigned largest = delay->backlog_ns > 0 ? 0 : 1;
    for (unsigned i = largest + 1; i < sizeof part / sizeof part[0]; i++) {
        largest = part[i].ns > part[largest].ns ? i : largest;
    }
    return part[largest].cause;
}

rt_cause rt_cause_late(const rt_delay *delay, int64_t resp_ns, int64_t deadline_ns, int64_t stolen_ns) {
    return stolen_ns > 0 && resp_ns - stolen_ns <= deadline_ns ? RT_CAUSE_STEAL : rt_cause_largest(delay);
}
