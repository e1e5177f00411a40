/* The exported controller and its funnel monitor, C99 without allocation, state or any library but libm.
 *
 * Time [s] counts from the start of the motion; x = (positions, velocities) in SI units, angles not wrapped.
 * controller.json has units, signs and limits; controller_data.h has the numbers.
 */
#ifndef RTCD_CONTROLLER_H
#define RTCD_CONTROLLER_H

#include "controller_size.h"

#ifdef __cplusplus
extern "C" {
#endif

/* Where a state is in the funnel now. ratio is V/rho: 0 on the nominal motion, 1 on the funnel's boundary.
 * margin = 1 - ratio, negative outside. abort_advised: ratio above the given one, or beyond the states' limits. */
typedef struct {
    double ratio;
    double margin;
    int inside;
    int abort_advised;
} rtcd_monitor;

/* V/rho above which to advise the end of an experiment: twice as far from the nominal motion as the funnel reaches. */
#define RTCD_ABORT_RATIO 4.0

/* The nominal state x*(t). */
void rtcd_nominal(double t, double x[RTCD_STATES]);

/* u = clip(u*(t) - K(t) (x - x*(t))); zero if x or t is not finite. */
void rtcd_control(double t, const double x[RTCD_STATES], double u[RTCD_INPUTS]);

/* Whether x is inside the funnel at time t. */
rtcd_monitor rtcd_watch(double t, const double x[RTCD_STATES], double abort_ratio);

#ifdef __cplusplus
}
#endif

#endif
