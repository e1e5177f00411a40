/* The exported controller and its funnel monitor, C99 without allocation, state or any library but libm.
 *
 * Time [s] counts from the start of the motion; x = (positions, velocities) in SI units, angles not wrapped
 * (rtcd_unwrap is for measured ones that are).
 * rtcd_controller.json has units, signs and limits; rtcd_controller_data.h has the numbers.
 *
 * Where x, t or what follows from them is not finite, the input is zero and the state counts as outside, under any
 * option of the compiler (-ffast-math removes isnan and its like, so exponents are tested as integers).
 */
#ifndef RTCD_CONTROLLER_H
#define RTCD_CONTROLLER_H

#include "rtcd_controller_size.h"

#ifdef __cplusplus
extern "C" {
#endif

/* SHA-256 of the claim that the certificate proves about this controller; empty without one. */
extern const char rtcd_claim[];

/* Where a state is in the funnel now. ratio is |y|^2 in the proved funnel and V/rho in the sampled one: 0 on the
 * nominal motion, 1 on the funnel's boundary, DBL_MAX where it is not finite. margin = 1 - ratio, negative outside.
 * abort_advised: ratio above the given one, or beyond the states' limits. proved: which funnel it is. */
typedef struct {
    double ratio;
    double margin;
    int inside;
    int abort_advised;
    int proved;
} rtcd_monitor;

/* Ratio above which to advise the end of an experiment: twice as far from the nominal motion as the funnel reaches. */
#define RTCD_ABORT_RATIO 4.0

/* The nominal state x*(t). */
void rtcd_nominal(double t, double x[RTCD_STATES]);

/* Takes every angle of x into the turn that is nearest to x*(t), for encoders that lose whole turns: call it before the
 * two below. */
void rtcd_unwrap(double t, double x[RTCD_STATES]);

/* u = clip(u*(t) - K(t) (x - x*(t))); zero if x or t is not finite. */
void rtcd_control(double t, const double x[RTCD_STATES], double u[RTCD_INPUTS]);

/* Whether x is inside the funnel at time t. */
rtcd_monitor rtcd_watch(double t, const double x[RTCD_STATES], double abort_ratio);

#ifdef __cplusplus
}
#endif

#endif
