/* Compares the controller with test_vectors.csv, then times it:
 *     cc -std=c99 -O2 rtcd_controller_test.c rtcd_controller.c -lm -o controller_test && ./controller_test
 * Ends with 0 if every input (as a share of its limit) and every ratio (as a share of 1 + ratio) agrees, every input is
 * finite, and the monitor says inside, abort and proved where the table does. The table has states that are not finite. */
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "rtcd_controller.h"

#define TOLERANCE 1e-6
#define STEPS 1000000
#define COLUMNS (1 + RTCD_STATES + RTCD_INPUTS + 4)

static const double limits[RTCD_INPUTS] = RTCD_INPUT_LIMITS;

/* Reads count numbers and what separates them; 0 at the file's end. */
static int read_row(FILE *file, double *row, int count)
{
    for (int i = 0; i < count; i++)
        if (fscanf(file, "%lf%*[,\r\n]", &row[i]) != 1)
            return 0;
    return 1;
}

/* By the exponent's bits: -ffast-math takes no account of what is not finite. */
static int finite(const double *value)
{
    uint64_t bits;
    memcpy(&bits, value, sizeof bits);
    return ((bits >> 52) & 0x7ff) != 0x7ff;
}

int main(int count, char **arguments)
{
    const char *path = count > 1 ? arguments[1] : "test_vectors.csv";
    FILE *file = fopen(path, "r");
    if (!file) {
        fprintf(stderr, "cannot read %s\n", path);
        return 2;
    }
    double row[COLUMNS], u[RTCD_INPUTS], worst = 0.0;
    int rows = 0, wrong = 0;
    if (fscanf(file, "%*[^\n]%*c") == EOF)
        return 2;
    while (read_row(file, row, COLUMNS)) {
        const double *wanted = row + 1 + RTCD_STATES, *flags = wanted + RTCD_INPUTS + 1, ratio = flags[-1];
        rtcd_control(row[0], row + 1, u);
        for (int j = 0; j < RTCD_INPUTS; j++) {
            wrong += !finite(&u[j]);
            worst = fmax(worst, fabs(u[j] - wanted[j]) / limits[j]);
        }
        const rtcd_monitor now = rtcd_watch(row[0], row + 1, RTCD_ABORT_RATIO);
        wrong += !finite(&now.ratio);
        wrong += now.inside != (int)flags[0] || now.abort_advised != (int)flags[1] || now.proved != (int)flags[2];
        worst = fmax(worst, fabs(now.ratio - ratio) / (1.0 + ratio));
        rows++;
    }
    fclose(file);
    const int good = rows > 0 && wrong == 0 && worst <= TOLERANCE;
    printf("%s: %d vectors, largest deviation %.2g, allowed %g, %d wrong answers\n", good ? "ok" : "FAILED", rows, worst,
           TOLERANCE, wrong);

    double x[RTCD_STATES] = {0}, sum = 0.0;
    const clock_t begin = clock();
    for (int i = 0; i < STEPS; i++) {
        x[0] = 1e-9 * i;
        rtcd_control(1e-6 * i, x, u);
        sum += u[0] + rtcd_watch(1e-6 * i, x, RTCD_ABORT_RATIO).ratio;
    }
    const double each = 1e9 * (double)(clock() - begin) / CLOCKS_PER_SEC / STEPS;
    printf("%.0f ns for a step of controller and monitor (checksum %g)\n", each, sum);
    return good ? EXIT_SUCCESS : EXIT_FAILURE;
}
