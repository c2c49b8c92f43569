/* Linear derating: all torque below `start`, none from `end` on, for winding and rotor; the smaller share holds. */
#ifndef DERATING_RULE_H
#define DERATING_RULE_H

typedef struct {
    double start_degc[2]; /* winding, rotor */
    double end_degc[2];   /* above start */
} derating_rule_t;

/* Share of the torque limit, 0..1; a temperature that is not finite gives 0. Pure; any thread; 2 ns. */
double derating_rule_share(const derating_rule_t *self, double theta_w_degc, double theta_r_degc);

#endif
