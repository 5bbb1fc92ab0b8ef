/* Estimates of the filter on a log: the table that `quad-gym replay` reads, as a .csv file.
 *
 *     example LOG.csv [--heading DEGREES] [--course] [--start-position X Y Z] [--time REPEATS]
 *
 * prints the estimates as `quad-gym replay` writes them to estimates.csv. This program allocates
 * memory for the log; the filter allocates none. */
#define QUAD_GYM_FILTER_IMPLEMENTATION
#include "quad_gym_filter.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#if defined(__GNUC__) && !defined(__clang__)
#pragma GCC optimize("fp-contract=off") /* as in Python */
#endif

#define SAME_TIME 1e-6
#define PATIENCE 2.0 /* time for which a start waits for the first magnetic field [s] */
#define FEATURES 64
#define PI 3.141592653589793

enum { TIME, RECEIVED, GYRO, ACCEL = GYRO + 3, GNSS = ACCEL + 3, LLA = GNSS + 3, ENU = LLA + 3,
       SIGMA = ENU + 3, VELOCITY = SIGMA + 3, VELOCITY_ENU = VELOCITY + 3,
       VELOCITY_SIGMA = VELOCITY_ENU + 3, BASELINE, BASELINE_ENU = BASELINE + 3,
       BAROMETER = BASELINE_ENU + 3, MAGNETOMETER, PIXELS = MAGNETOMETER + 3,
       COLUMNS = PIXELS + 2 * FEATURES };

static const char *const names[PIXELS] = {
    "time", "received", "gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z",
    "gnss_x", "gnss_y", "gnss_z", "gnss_lat", "gnss_lon", "gnss_alt",
    "gnss_east", "gnss_north", "gnss_up", "gnss_sigma_east", "gnss_sigma_north", "gnss_sigma_up",
    "gnss_velocity_x", "gnss_velocity_y", "gnss_velocity_z",
    "gnss_velocity_east", "gnss_velocity_north", "gnss_velocity_up", "gnss_velocity_sigma",
    "gnss_baseline_x", "gnss_baseline_y", "gnss_baseline_z",
    "gnss_baseline_east", "gnss_baseline_north", "gnss_baseline_up", "barometer",
    "magnetometer_x", "magnetometer_y", "magnetometer_z"};

enum { IMU_STREAM, GNSS_STREAM, CAMERA_STREAM, BAROMETER_STREAM, MAGNETOMETER_STREAM };

typedef struct {
    double received, time;
    int stream;
    const double *row;
} arrival;

static qg_filter filter;
static double *table;
static arrival *arrivals;
static size_t rows, arrival_count;
static double heading = NAN, position[3];
static int course, starts_at_position, silent, too_late;

static void stop(const char *why, const char *what)
{
    fprintf(stderr, "error: %s%s\n", why, what);
    exit(2);
}

/* ---- the log ---- */

static int column_of(const char *name)
{
    int feature, i;
    char axis, rest;
    for (i = 0; i < PIXELS; i++)
        if (!strcmp(name, names[i]))
            return i;
    if (sscanf(name, "pixel_%d_%c%c", &feature, &axis, &rest) == 2 && feature >= 0 &&
        feature < FEATURES && (axis == 'u' || axis == 'v'))
        return PIXELS + 2 * feature + (axis == 'v');
    stop("unknown column ", name);
    return 0;
}

static char *trimmed(char *text)
{
    size_t n;
    text += strspn(text, " \t\r\"");
    for (n = strlen(text); n && strchr(" \t\r\"", text[n - 1]);)
        text[--n] = 0;
    return text;
}

static void read_log(const char *path)
{
    FILE *file = fopen(path, "rb");
    int place[COLUMNS], count = 0;
    size_t size = 0, room = 1 << 16, k, lines = 0;
    char *text = malloc(room + 1), *line, *next;
    if (!file || !text)
        stop("cannot read ", path);
    while ((k = fread(text + size, 1, room - size, file)) > 0)
        if ((size += k) == room && !(text = realloc(text, (room *= 2) + 1)))
            stop("out of memory for ", path);
    fclose(file);
    text[size] = 0;
    for (k = 0; k < size; k++)
        lines += text[k] == '\n';
    table = malloc((lines + 1) * COLUMNS * sizeof *table);
    if (!table)
        stop("out of memory for ", path);
    line = strncmp(text, "\xef\xbb\xbf", 3) ? text : text + 3;
    for (int first = 1; line; line = next) {
        double *row = table + rows * COLUMNS;
        char *cell = line, *comma;
        int i = 0;
        if ((next = strchr(line, '\n')))
            *next++ = 0;
        if (!*trimmed(line))
            continue;
        for (int j = 0; !first && j < COLUMNS; j++)
            row[j] = NAN;
        for (; cell; cell = comma, i++) {
            char *end;
            if ((comma = strchr(cell, ',')))
                *comma++ = 0;
            cell = trimmed(cell);
            if (first) {
                if (i == COLUMNS)
                    stop("too many columns in ", path);
                place[i] = column_of(cell);
                count = i + 1;
            } else if (i < count && *cell) {
                row[place[i]] = strtod(cell, &end);
                if (*end)
                    stop("not a number: ", cell);
            }
        }
        if (i != count)
            stop("rows must have as many cells as the first line: ", path);
        rows += !first;
        first = 0;
    }
    free(text);
}

static int all_finite(const double *x, int n)
{
    while (n-- > 0)
        if (!isfinite(x[n]))
            return 0;
    return 1;
}

static int any_finite(const double *x, int n)
{
    while (n-- > 0)
        if (isfinite(x[n]))
            return 1;
    return 0;
}

static void arrive(int stream, const double *row, double received, double delay)
{
    arrival *a = &arrivals[arrival_count++];
    if (!isfinite(row[TIME]) || !isfinite(received))
        stop("time and received must be finite where something was measured", "");
    a->received = received;
    a->time = row[TIME] - delay;
    a->stream = stream;
    a->row = row;
}

static int in_order(const void *one, const void *two)
{
    const arrival *a = one, *b = two;
    if (a->received != b->received)
        return a->received < b->received ? -1 : 1;
    if (a->stream != b->stream)
        return a->stream - b->stream;
    return a->row < b->row ? -1 : a->row > b->row;
}

static void sort_arrivals(void)
{
    double latest = -INFINITY;
    (void)any_finite;
    arrivals = malloc((5 * rows + 1) * sizeof *arrivals);
    if (!arrivals)
        stop("out of memory", "");
    for (size_t k = 0; k < rows; k++) {
        const double *row = table + k * COLUMNS;
        double received;
        latest = row[TIME] > latest ? row[TIME] : latest;
        received = isnan(row[RECEIVED]) ? latest : row[RECEIVED];
        if (all_finite(row + GYRO, 6))
            arrive(IMU_STREAM, row, received, 0.0);
#ifdef QG_GNSS
        if (any_finite(row + GNSS, SIGMA - GNSS) || any_finite(row + VELOCITY, 6) ||
            any_finite(row + BASELINE, 6))
            arrive(GNSS_STREAM, row, received, @DELAY_GNSS@);
#endif
#ifdef QG_FEATURES
        if (any_finite(row + PIXELS, 2 * FEATURES))
            arrive(CAMERA_STREAM, row, received, @DELAY_CAMERA@);
#endif
#ifdef QG_BAROMETER
        if (isfinite(row[BAROMETER]))
            arrive(BAROMETER_STREAM, row, received, @DELAY_BAROMETER@);
#endif
#ifdef QG_MAGNETOMETER
        if (any_finite(row + MAGNETOMETER, 3))
            arrive(MAGNETOMETER_STREAM, row, received, @DELAY_MAGNETOMETER@);
#endif
    }
    qsort(arrivals, arrival_count, sizeof *arrivals, in_order);
}

/* ---- the filter ---- */

static void demand(int result, const char *what)
{
    static const char *const words[] = {
        "", "the filter has not started", "a value is not finite", "a value is out of its range",
        "a time stamp is too old", "a time stamp is too new", "too many measurements wait",
        "the heading is unknown: the log must have a baseline or a magnetic field, or give "
        "--heading or --course", "measurements exclude each other"};
    if (result != QG_OK) {
        fprintf(stderr, "error: %s: %s\n", what, words[result]);
        exit(2);
    }
}

static void print_estimate(void)
{
    qg_estimate e;
    demand(qg_state(&filter, &e), "estimate");
    if (silent)
        return;
    printf("%.17g", e.time);
    for (int i = 0; i < 3; i++) printf(",%.17g", e.position[i]);
    for (int i = 0; i < 3; i++) printf(",%.17g", e.velocity[i]);
    for (int i = 0; i < 4; i++) printf(",%.17g", e.quaternion[i]);
    for (int i = 0; i < 3; i++) printf(",%.17g", e.accel_bias[i]);
    for (int i = 0; i < 3; i++) printf(",%.17g", e.gyro_bias[i]);
    for (int i = 0; i < 15; i++) printf(",%.17g", e.sigma[i]);
    printf(",%d\n", e.diverged);
}

static void print_names(void)
{
    static const char *const kinds[] = {"position", "velocity", "attitude", "accel_bias",
                                        "gyro_bias"};
    printf("time,position_x,position_y,position_z,velocity_x,velocity_y,velocity_z,quaternion_w,"
           "quaternion_x,quaternion_y,quaternion_z,accel_bias_x,accel_bias_y,accel_bias_z,"
           "gyro_bias_x,gyro_bias_y,gyro_bias_z");
    for (int k = 0; k < 15; k++)
        printf(",%s_sigma_%c", kinds[k / 3], 'x' + k % 3);
    printf(",diverged\n");
}

static const arrival *before; /* the sample that holds now, of an IMU of instants */

static void predict(const arrival *a)
{
    const arrival *chosen = QG_IMU_AVERAGES ? a : before;
    double step = a->time - qg_time(&filter);
    before = a;
    if (step <= SAME_TIME || !chosen)
        return;
    if (step > QG_LONGEST_STEP)
        stop("samples of the IMU must have no gap of more than a second", "");
    demand(qg_predict(&filter, chosen->row + GYRO, chosen->row + ACCEL, step), "IMU");
}

#ifdef QG_GNSS
static const double R_IG[9] = {@R_IG@};
static const double reference[3] = {@REFERENCE@};

/* A vector in G from its columns in ECEF, or else in I. */
static int vector_G(const double *in_G, const double *in_I, double out[3])
{
    if (all_finite(in_G, 3)) {
        memcpy(out, in_G, 3 * sizeof *out);
        return 1;
    }
    if (!all_finite(in_I, 3))
        return 0;
    for (int i = 0; i < 3; i++)
        out[i] = R_IG[i] * in_I[0] + R_IG[3 + i] * in_I[1] + R_IG[6 + i] * in_I[2];
    return 1;
}

static int position_G(const double *row, double out[3])
{
    double fix[3], distance = 0.0;
    if (all_finite(row + LLA, 3)) {
        const double a = 6378137.0, flattening = 1.0 / 298.257223563;
        const double e2 = flattening * (2.0 - flattening);
        const double lat = row[LLA] * (PI / 180.0), lon = row[LLA + 1] * (PI / 180.0);
        const double s = sin(lat), c = cos(lat), N = a / sqrt(1.0 - e2 * pow(s, 2.0));
        const double p = (N + row[LLA + 2]) * c;
        fix[0] = p * cos(lon);
        fix[1] = p * sin(lon);
        fix[2] = (N * (1.0 - e2) + row[LLA + 2]) * s;
    } else if (all_finite(row + GNSS, 3)) {
        memcpy(fix, row + GNSS, sizeof fix);
    } else {
        return vector_G(row + GNSS, row + ENU, out);
    }
    for (int i = 0; i < 3; i++) {
        out[i] = fix[i] - reference[i];
        distance += out[i] * out[i];
    }
    if (distance > 1e10)
        stop("the log is farther than 100 km from the suite's reference antenna: export the filter "
             "of a suite with GnssParams.reference_antenna_G near the log", "");
    return 1;
}

static double tilt_sigma, rest_sigma; /* of a start in motion; 0: the suite's */

/* A start in motion is uncertain: roll, pitch and velocity by the speed at the first fix, from the
 * positions of a second with a constant acceleration, as in quad_gym.estimation.first_motion. */
static void find_motion(void)
{
    double begin = NAN, nearest = INFINITY, turning = 0.0, S[5] = {0}, c[3], det, v[3] = {0};
    double speed, spread, p[3];
    for (size_t k = 0; k < rows; k++) {
        const double *row = table + k * COLUMNS;
        if (!isnan(row[TIME]) && position_G(row, p)) {
            double t = row[TIME] - @DELAY_GNSS@, power = 1.0;
            begin = isnan(begin) ? t : begin;
            for (int i = 0; t < begin + @MOTION_SPAN@ && i < 5; i++, power *= t - begin)
                S[i] += power;
        }
    }
    c[0] = S[1] * S[2] - S[3] * S[0];
    c[1] = S[4] * S[0] - S[2] * S[2];
    c[2] = S[3] * S[2] - S[4] * S[1];
    det = S[3] * c[0] + S[2] * c[1] + S[1] * c[2];
    for (size_t k = 0; k < rows; k++) {
        const double *row = table + k * COLUMNS;
        const double t = row[TIME] - @DELAY_GNSS@ - begin;
        if (!isnan(row[TIME]) && position_G(row, p) && t < @MOTION_SPAN@)
            for (int i = 0; i < 3; i++)
                v[i] += (c[0] * t * t + c[1] * t + c[2]) / det * p[i];
        if (all_finite(row + GYRO, 6) && fabs(row[TIME] - begin) < nearest) {
            const double *w = row + GYRO;
            nearest = fabs(row[TIME] - begin);
            turning = sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2]);
        }
    }
    speed = S[0] > 3.5 ? sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]) : 0.0;
    spread = S[0] > 3.5 ? @MOST_POSITION_SIGMA@ * sqrt(c[1] / det) : INFINITY;
    if ((speed > @MOTION_FAST@ && speed > @MOTION_CERTAIN@ * spread) || turning > @MOTION_TURNING@) {
        tilt_sigma = @MOTION_TILT@;
        rest_sigma = 1.0 + rint(speed);
        rest_sigma = rest_sigma > @SUITE_SPEED_SIGMA@ ? rest_sigma : 0.0;
    }
}

static const double *field; /* the last magnetic field before the start */

#ifdef QG_MAGNETOMETER
static int measures_field(void)
{
    for (size_t k = 0; k < arrival_count; k++)
        if (arrivals[k].stream == MAGNETOMETER_STREAM)
            return 1;
    return 0;
}
#endif

static void try_to_start(const arrival *a)
{
    static double first_fix = INFINITY;
    double fix[3], baseline[3], velocity[3];
    qg_start s;
    if (a->stream == MAGNETOMETER_STREAM)
        field = a->row + MAGNETOMETER;
    if (a->stream != GNSS_STREAM || !position_G(a->row, fix))
        return;
    memset(&s, 0, sizeof s);
    s.time = a->time;
    s.gnss_position = fix;
    if (all_finite(a->row + SIGMA, 3))
        s.gnss_sigma = a->row + SIGMA;
#ifdef QG_GNSS_BASELINE
    if (vector_G(a->row + BASELINE, a->row + BASELINE_ENU, baseline))
        s.gnss_baseline = baseline;
#endif
#ifdef QG_GNSS_VELOCITY
    if (vector_G(a->row + VELOCITY, a->row + VELOCITY_ENU, velocity)) {
        s.gnss_velocity = velocity;
        if (isfinite(a->row[VELOCITY_SIGMA]))
            s.velocity_sigma = a->row[VELOCITY_SIGMA];
    }
#endif
    (void)baseline, (void)velocity;
    s.heading = isnan(heading) ? 0 : &heading;
    s.course = course;
    s.tilt_sigma = tilt_sigma;
    s.rest_sigma = rest_sigma;
#ifdef QG_MAGNETOMETER
    if (!s.gnss_baseline && !s.heading && !course) {
        first_fix = a->received < first_fix ? a->received : first_fix;
        if (!field && measures_field() && a->received < first_fix + PATIENCE)
            return;
        s.magnetometer = field;
    }
#endif
    (void)first_fix;
    demand(qg_init(&filter, &s), "start");
}
#endif

static void update(const arrival *a)
{
    qg_measurements m;
    double fix[3], baseline[3], velocity[3];
    int result;
    memset(&m, 0, sizeof m);
#ifdef QG_GNSS
    if (a->stream == GNSS_STREAM) {
        if (position_G(a->row, fix)) {
            m.gnss_position = fix;
            if (all_finite(a->row + SIGMA, 3))
                m.gnss_sigma = a->row + SIGMA;
        }
#ifdef QG_GNSS_BASELINE
        if (vector_G(a->row + BASELINE, a->row + BASELINE_ENU, baseline))
            m.gnss_baseline = baseline;
#endif
#ifdef QG_GNSS_VELOCITY
        if (vector_G(a->row + VELOCITY, a->row + VELOCITY_ENU, velocity)) {
            m.gnss_velocity = velocity;
            if (isfinite(a->row[VELOCITY_SIGMA]))
                m.velocity_sigma = a->row[VELOCITY_SIGMA];
        }
        if (!m.gnss_velocity)
#endif
#ifdef QG_GNSS_BASELINE
        if (!m.gnss_baseline)
#endif
        if (!m.gnss_position)
            return;
    }
#endif
    (void)fix, (void)baseline, (void)velocity;
#ifdef QG_FEATURES
    if (a->stream == CAMERA_STREAM)
        m.pixels = a->row + PIXELS;
#endif
#ifdef QG_BAROMETER
    if (a->stream == BAROMETER_STREAM)
        m.barometer = a->row + BAROMETER;
#endif
#ifdef QG_MAGNETOMETER
    if (a->stream == MAGNETOMETER_STREAM) {
        if (!all_finite(a->row + MAGNETOMETER, 3))
            return;
        m.magnetometer = a->row + MAGNETOMETER;
    }
#endif
    result = qg_update(&filter, &m, a->time);
    if (result == QG_TOO_OLD)
        too_late++;
    else
        demand(result, "measurement");
}

static void replay(void)
{
    int running = 0;
    before = 0;
    if (starts_at_position) {
        size_t k = 0;
        while (k < arrival_count && arrivals[k].stream != IMU_STREAM)
            k++;
        if (k == arrival_count)
            stop("the log has no sample of the IMU", "");
        demand(qg_init_at_rest(&filter, position, heading, arrivals[k].time), "start");
        running = 1;
    }
    for (size_t k = 0; k < arrival_count; k++) {
        const arrival *a = &arrivals[k];
        if (running && a->stream == IMU_STREAM) {
            print_estimate();
            predict(a);
        } else if (running) {
            update(a);
        }
#ifdef QG_GNSS
        else if (a->stream != IMU_STREAM) {
            filter.started = 0;
            try_to_start(a);
            if (filter.started) { /* process the samples since the time of the fix */
                const double begin = qg_time(&filter);
                running = 1;
                for (const arrival *held = arrivals; held < a; held++) {
                    if (held->stream == IMU_STREAM && held->time > begin + SAME_TIME)
                        predict(held);
                    else if (held->stream == IMU_STREAM)
                        before = held;
                }
            }
        }
#endif
    }
    if (!running)
        stop("the log must have a GNSS position to start from, or give --start-position X Y Z "
             "--heading DEGREES", "");
    print_estimate();
    if (too_late && !silent)
        fprintf(stderr, "%d measurements came too late for the window\n", too_late);
}

int main(int count, char **words)
{
    const char *path = 0;
    int repeats = 0;
    for (int k = 1; k < count; k++) {
        if (!strcmp(words[k], "--heading") && k + 1 < count)
            heading = atof(words[++k]) * (PI / 180.0);
        else if (!strcmp(words[k], "--course"))
            course = 1;
        else if (!strcmp(words[k], "--time") && k + 1 < count)
            repeats = atoi(words[++k]);
        else if (!strcmp(words[k], "--start-position") && k + 3 < count) {
            starts_at_position = 1;
            for (int i = 0; i < 3; i++)
                position[i] = atof(words[++k]);
        } else if (words[k][0] != '-' && !path)
            path = words[k];
        else
            stop("unknown option ", words[k]);
    }
    if (!path)
        stop("usage: example LOG.csv [--heading DEGREES] [--course] [--start-position X Y Z] "
             "[--time REPEATS]", "");
    if (starts_at_position && isnan(heading))
        stop("--start-position must come with --heading", "");
    read_log(path);
    sort_arrivals();
#ifdef QG_GNSS
    if (@MOTION_TILT@ > 0.0)
        find_motion();
#endif
    if (repeats > 0) {
        clock_t begin = clock();
        silent = 1;
        for (int k = 0; k < repeats; k++)
            replay();
        printf("%.3f us per arrival of %zu\n",
               1e6 * (double)(clock() - begin) / CLOCKS_PER_SEC / repeats / (double)arrival_count,
               arrival_count);
        return 0;
    }
    print_names();
    replay();
    return 0;
}
