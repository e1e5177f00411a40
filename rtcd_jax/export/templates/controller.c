/* On [t_k, t_k+1], with s = (t - t_k) / dt: u = clip(u_k - K(t) (x - x*(t))), x* the cubic Hermite interpolant of x_k
 * and its rates, K linear between K_k and K_k+1; before t_0 the first instant is held; from t_N on
 * u = clip(-K_goal (x - x_goal)). The funnel is {x : V = (x - x*)' S(t) (x - x*) <= rho(t)}, S the cubic Hermite
 * interpolant of S_k and its rates, log rho linear. */
#include "controller.h"

#include <math.h>

#include "controller_data.h"

enum { N = RTCD_STATES, M = RTCD_INPUTS, INTERVALS = RTCD_INTERVALS };

/* The interval of t and, in *s, the fraction of it; INTERVALS behind the last one. */
static int place(double t, double *s)
{
    *s = 0.0;
    if (t >= RTCD_DURATION)
        return INTERVALS;
    if (t <= 0.0)
        return 0;
    int k = (int)(t / RTCD_DT);
    if (k > INTERVALS - 1)
        k = INTERVALS - 1;
    *s = t / RTCD_DT - k;
    return k;
}

static double cubic(double s, double start, double start_rate, double end, double end_rate)
{
    const double r = 1.0 - s;
    return r * r * ((1.0 + 2.0 * s) * start + s * RTCD_DT * start_rate)
         + s * s * ((3.0 - 2.0 * s) * end - r * RTCD_DT * end_rate);
}

static void nominal_at(int k, double s, double x[N])
{
    for (int i = 0; i < N; i++)
        x[i] = k == INTERVALS
             ? RTCD_X_GOAL[i]
             : cubic(s, RTCD_X[k][i], RTCD_X_RATES[k][0][i], RTCD_X[k + 1][i], RTCD_X_RATES[k][1][i]);
}

static int finite_all(double t, const double x[N])
{
    int finite = isfinite(t) != 0;
    for (int i = 0; i < N; i++)
        finite = finite && isfinite(x[i]);
    return finite;
}

void rtcd_nominal(double t, double x[RTCD_STATES])
{
    double s;
    const int k = place(t, &s);
    nominal_at(k, s, x);
}

void rtcd_control(double t, const double x[RTCD_STATES], double u[RTCD_INPUTS])
{
    double s, nominal[N];
    const int finite = finite_all(t, x);
    const int k = finite ? place(t, &s) : INTERVALS;
    if (finite)
        nominal_at(k, s, nominal);
    for (int j = 0; j < M; j++) {
        if (!finite) {
            u[j] = 0.0;
            continue;
        }
        double value = k == INTERVALS ? 0.0 : RTCD_U[k][j];
        for (int i = 0; i < N; i++) {
            const double gain = k == INTERVALS ? RTCD_K_GOAL[j][i] : (1.0 - s) * RTCD_K[k][j][i] + s * RTCD_K[k + 1][j][i];
            value -= gain * (x[i] - nominal[i]);
        }
        u[j] = fmin(fmax(value, -RTCD_U_MAX[j]), RTCD_U_MAX[j]);
    }
}

/* S(t), entry by entry. */
static double value_at(int k, double s, int i, int j)
{
    return k == INTERVALS
         ? RTCD_S[k][i][j]
         : cubic(s, RTCD_S[k][i][j], RTCD_S_RATES[k][0][i][j], RTCD_S[k + 1][i][j], RTCD_S_RATES[k][1][i][j]);
}

rtcd_monitor rtcd_watch(double t, const double x[RTCD_STATES], double abort_ratio)
{
    rtcd_monitor now = {HUGE_VAL, -HUGE_VAL, 0, 1};
    if (!finite_all(t, x))
        return now;
    double s, nominal[N], value = 0.0;
    const int k = place(t, &s);
    const int next = k == INTERVALS ? k : k + 1;
    int outside = 0;
    nominal_at(k, s, nominal);
    for (int i = 0; i < N; i++) {
        outside = outside || fabs(x[i]) > RTCD_STATE_LIMITS[i];
        for (int j = 0; j < N; j++)
            value += (x[i] - nominal[i]) * value_at(k, s, i, j) * (x[j] - nominal[j]);
    }
    now.ratio = fmax(value, 0.0) * exp(-((1.0 - s) * RTCD_LOG_RHO[k] + s * RTCD_LOG_RHO[next]));
    now.margin = 1.0 - now.ratio;
    now.inside = now.ratio <= 1.0 && !outside;
    now.abort_advised = now.ratio > abort_ratio || outside;
    return now;
}
