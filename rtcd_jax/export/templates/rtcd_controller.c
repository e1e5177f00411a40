/* On [t_k, t_k+1], with s = (t - t_k) / dt: u = clip(u_k - K(t) (x - x*(t))), x* the cubic Hermite interpolant of x_k
 * and its rates, K linear between K_k and K_k+1; before t_0 the first instant is held; from t_N on
 * u = clip(-K_goal (x - x_goal)). The proved funnel, if there is a certificate, is {x* + L(t) y : |y| <= 1} with the
 * certificate's L, after t_N its region of the goal. The sampled one is {x : V = (x - x*)' S(t) (x - x*) <= rho(t)},
 * S the cubic Hermite interpolant of S_k and its rates, log rho linear. A motion that ends in a catch set is over at t_N:
 * afterwards the input is zero, and every state counts as outside. */
#include "rtcd_controller.h"

#include <float.h>
#include <math.h>
#include <stdint.h>
#include <string.h>

#include "rtcd_controller_data.h"

enum { N = RTCD_STATES, M = RTCD_INPUTS, INTERVALS = RTCD_INTERVALS };

static const double TURN = 6.283185307179586;

const char rtcd_claim[] = "";

/* By the exponent's bits, read where the numbers lie: no assumption of the compiler about doubles applies. */
static int finite_all(const double *values, int count)
{
    int finite = 1;
    for (int i = 0; i < count; i++) {
        uint64_t bits;
        memcpy(&bits, values + i, sizeof bits);
        finite = finite && ((bits >> 52) & 0x7ff) != 0x7ff;
    }
    return finite;
}

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

/* Whether the motion has ended in its catch set before t. */
static int over(double t)
{
    return RTCD_CAUGHT && t > RTCD_DURATION;
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

void rtcd_nominal(double t, double x[RTCD_STATES])
{
    double s = 0.0;
    const int k = finite_all(&t, 1) ? place(t, &s) : INTERVALS;
    nominal_at(k, s, x);
}

void rtcd_control(double t, const double x[RTCD_STATES], double u[RTCD_INPUTS])
{
    for (int j = 0; j < M; j++)
        u[j] = 0.0;
    if (!finite_all(&t, 1) || !finite_all(x, N) || over(t))
        return;
    double s, nominal[N], wanted[M];
    const int k = place(t, &s);
    nominal_at(k, s, nominal);
    for (int j = 0; j < M; j++) {
        wanted[j] = k == INTERVALS ? 0.0 : RTCD_U[k][j];
        for (int i = 0; i < N; i++) {
            const double gain = k == INTERVALS ? RTCD_K_GOAL[j][i] : (1.0 - s) * RTCD_K[k][j][i] + s * RTCD_K[k + 1][j][i];
            wanted[j] -= gain * (x[i] - nominal[i]);
        }
    }
    if (!finite_all(wanted, M))
        return;
    for (int j = 0; j < M; j++)
        u[j] = fmin(fmax(wanted[j], -RTCD_U_MAX[j]), RTCD_U_MAX[j]);
}

/* S(t), entry by entry. */
static double value_at(int k, double s, int i, int j)
{
    return k == INTERVALS
         ? RTCD_S[k][i][j]
         : cubic(s, RTCD_S[k][i][j], RTCD_S_RATES[k][0][i][j], RTCD_S[k + 1][i][j], RTCD_S_RATES[k][1][i][j]);
}

static double sampled_ratio(int k, double s, const double error[N])
{
    const int next = k == INTERVALS ? k : k + 1;
    double value = 0.0;
    for (int i = 0; i < N; i++)
        for (int j = 0; j < N; j++)
            value += error[i] * value_at(k, s, i, j) * error[j];
    return value * exp(-((1.0 - s) * RTCD_LOG_RHO[k] + s * RTCD_LOG_RHO[next]));
}

#if RTCD_PIECES > 0
/* |y|^2 of L y = error, by elimination with pivots. */
static double squared_length(double axes[N][N], const double error[N])
{
    double y[N], square = 0.0;
    for (int i = 0; i < N; i++)
        y[i] = error[i];
    for (int column = 0; column < N; column++) {
        int pivot = column;
        for (int i = column + 1; i < N; i++)
            if (fabs(axes[i][column]) > fabs(axes[pivot][column]))
                pivot = i;
        for (int j = 0; j < N; j++) {
            const double kept = axes[column][j];
            axes[column][j] = axes[pivot][j];
            axes[pivot][j] = kept;
        }
        const double kept = y[column];
        y[column] = y[pivot];
        y[pivot] = kept;
        for (int i = column + 1; i < N; i++) {
            const double share = axes[i][column] / axes[column][column];
            for (int j = column; j < N; j++)
                axes[i][j] -= share * axes[column][j];
            y[i] -= share * y[column];
        }
    }
    for (int i = N - 1; i >= 0; i--) {
        for (int j = i + 1; j < N; j++)
            y[i] -= axes[i][j] * y[j];
        y[i] /= axes[i][i];
        square += y[i] * y[i];
    }
    return square;
}

/* |y|^2 where x = x* + L(t) y; L is cubic between two of RTCD_PROOF_BEGINS, the last one is the goal's. */
static double proved_ratio(int k, double s, const double error[N])
{
    const double at = k + s;
    int low = 0, high = RTCD_PIECES;
    while (high - low > 1) {
        const int middle = (low + high) / 2;
        if (RTCD_PROOF_BEGINS[middle] <= at)
            low = middle;
        else
            high = middle;
    }
    double local = 0.0, axes[N][N];
    if (low + 1 < RTCD_PIECES) {
        const double begin = RTCD_PROOF_BEGINS[low], end = RTCD_PROOF_BEGINS[low + 1];
        local = (2.0 * at - begin - end) / (end - begin);
    }
    for (int i = 0; i < N; i++)
        for (int j = 0; j < N; j++) {
            axes[i][j] = 0.0;
            for (int power = 3; power >= 0; power--)
                axes[i][j] = axes[i][j] * local + RTCD_PROOF_AXES[low][power][i][j];
        }
    return squared_length(axes, error);
}
#endif

void rtcd_unwrap(double t, double x[RTCD_STATES])
{
    double s, nominal[N];
    if (!finite_all(&t, 1) || !finite_all(x, N))
        return;
    const int k = place(t, &s);
    nominal_at(k, s, nominal);
    for (int i = 0; i < N; i++)
        if (RTCD_ANGLES[i])
            x[i] -= TURN * floor((x[i] - nominal[i]) / TURN + 0.5);
}

rtcd_monitor rtcd_watch(double t, const double x[RTCD_STATES], double abort_ratio)
{
    rtcd_monitor now = {DBL_MAX, -DBL_MAX, 0, 1, 0};
    if (!finite_all(&t, 1))
        return now;
#if RTCD_PIECES > 0
    now.proved = t >= RTCD_PROOF_BEGINS[0] * RTCD_DT;
#endif
    if (!finite_all(x, N) || over(t))
        return now;
    double s, nominal[N], error[N];
    const int k = place(t, &s);
    int outside = 0;
    nominal_at(k, s, nominal);
    for (int i = 0; i < N; i++) {
        outside = outside || fabs(x[i]) > RTCD_STATE_LIMITS[i];
        error[i] = x[i] - nominal[i];
    }
#if RTCD_PIECES > 0
    const double ratio = now.proved ? proved_ratio(k, s, error) : sampled_ratio(k, s, error);
#else
    const double ratio = sampled_ratio(k, s, error);
#endif
    if (!finite_all(&ratio, 1))
        return now;
    now.ratio = fmax(ratio, 0.0);
    now.margin = 1.0 - now.ratio;
    now.inside = now.ratio <= 1.0 && !outside;
    now.abort_advised = now.ratio > abort_ratio || outside;
    return now;
}
