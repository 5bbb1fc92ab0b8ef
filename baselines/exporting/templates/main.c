/* Estimates of the filter for the calls of a replay.
 *
 *     quad-gym replay LOG --sensors SUITE --samples SAMPLES.csv
 *     example SAMPLES.csv [--time REPEATS]
 *
 * prints the estimates as the replay writes them to estimates.csv. Each row of the samples is a
 * call of the library, with its numbers; nan: not measured. */
#define QUAD_GYM_FILTER_IMPLEMENTATION
#include "quad_gym_filter.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#define MOST 160 /* numbers in a row */

static qg_filter filter;
static double x[MOST];
static qg_real real[MOST]; /* the same numbers */
static int silent;

static void stop(const char *what, const char *why)
{
    fprintf(stderr, "error: %s: %s\n", what, why);
    exit(2);
}

static void demand(int result, const char *what)
{
    static const char *const words[] = {@WORDS@};
    if (result != QG_OK)
        stop(what, words[result]);
}

static const double *given(int place)
{
    return isnan(x[place]) ? 0 : x + place;
}

static const qg_real *value(int place)
{
    return isnan(x[place]) ? 0 : real + place;
}

static double number(int place)
{
    return isnan(x[place]) ? 0.0 : x[place];
}

static void print_numbers(const qg_real *numbers, int n)
{
    while (n-- > 0)
        printf(",%.17g", (double)*numbers++);
}

static void print_estimate(void)
{
    static qg_real last[4]; // so that the sign of the quaternion does not change
    qg_estimate e;
    demand(qg_state(&filter, &e), "estimate");
    double product = 0.0;
    for (int i = 0; i < 4; i++)
        product += (double)e.quaternion[i] * last[i];
    for (int i = 0; i < 4; i++)
        last[i] = product < 0.0 ? -e.quaternion[i] : e.quaternion[i];
    if (silent)
        return;
    printf("%.17g,%.17g,%.17g,%.17g", e.time, e.position[0], e.position[1], e.position[2]);
    print_numbers(e.velocity, 3);
    print_numbers(last, 4);
    print_numbers(e.accel_bias, 3);
    print_numbers(e.gyro_bias, 3);
    print_numbers(e.sigma, 15);
    printf(",%d\n", e.diverged);
}

#ifdef QG_GNSS_POSITION
static void start(void)
{
    const qg_start s = {.time = x[0], .gnss_position = given(1), .gnss_sigma = given(4),
                        .gnss_baseline = given(7), .gnss_velocity = given(10),
                        .velocity_sigma = number(13), .heading = given(14),
                        .magnetometer = given(15), .course = x[18] != 0.0,
                        .tilt_sigma = number(19), .rest_sigma = number(20)};
    demand(qg_init(&filter, &s), "start");
}
#endif

/* Returns 0 for a row that is no measurement of the suite. */
static int update(const char *name)
{
    qg_measurements m = {0};
    (void)given, (void)value, (void)number;
@ROWS@        return 0;
    demand(qg_update(&filter, &m, x[0]), name);
    return 1;
}

static void call(char *row)
{
    char *next = strchr(row, ','), *name = row;
    int n = 0;
    if (next)
        *next++ = 0;
    else
        row[strcspn(row, "\r\n")] = 0;
    for (; next && n < MOST; n++) {
        char *end;
        x[n] = strtod(next, &end);
        if (end == next)
            stop("not a number", next);
        next = *end == ',' ? end + 1 : 0;
    }
    for (; n < MOST; n++)
        x[n] = NAN;
    for (n = 0; n < MOST; n++)
        real[n] = (qg_real)x[n];
    if (!strcmp(name, "imu"))
        demand(qg_predict(&filter, real, real + 3, x[6]), name);
    else if (!strcmp(name, "estimate"))
        print_estimate();
    else if (!strcmp(name, "rest"))
        demand(qg_init_at_rest(&filter, x, x[3], x[4]), name);
#ifdef QG_GNSS_POSITION
    else if (!strcmp(name, "start"))
        start();
    else if (!strcmp(name, "origin")) {
        static const double origin[3] = {@REFERENCE@};
        for (int i = 0; i < 3; i++)
            if (x[i] != origin[i])
                stop("the log has another origin",
                     "export the filter with --log LOG, and the options of its replay (--from)");
    }
#endif
#ifdef QG_BAROMETER
    else if (!strcmp(name, "level"))
        qg_barometer_from_start(&filter);
#endif
    else if (!update(name))
        stop("the suite has no such row", name);
}

int main(int count, char **words)
{
    int repeats = count == 4 && !strcmp(words[2], "--time") ? atoi(words[3]) : 0;
    FILE *file = count == 2 || repeats > 0 ? fopen(words[1], "rb") : 0;
    static char row[32 * MOST];
    clock_t begin = clock();
    long rows = 0;
    if (!file)
        stop("cannot read a file", "usage: example SAMPLES.csv [--time REPEATS]");
    silent = repeats > 0;
    if (!silent)
        printf("%s\n", "@COLUMNS@");
    do {
        rewind(file);
        for (; fgets(row, sizeof row, file); rows++)
            call(row);
    } while (--repeats > 0);
    if (silent)
        printf("%.3f us per row, reading included\n",
               1e6 * (double)(clock() - begin) / CLOCKS_PER_SEC / (double)(rows ? rows : 1));
    return 0;
}
