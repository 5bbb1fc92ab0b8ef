#include <math.h>
#include <string.h>

/* products and sums must be rounded one by one, as in Python */
#if defined(__clang__)
#pragma STDC FP_CONTRACT OFF
#elif defined(__GNUC__)
#pragma GCC push_options
#pragma GCC optimize("fp-contract=off")
#endif

#ifdef __cplusplus
extern "C" {
#endif

#define QGI_STAGE(name) \
    extern int name(void *, void *, void *, void *, void *, void *, void *, void *, int64_t)

typedef int qgi_run(void *, void *, void *, void *, const void *, void *, const void *, void *,
                    void *, const void *);
extern qgi_run qg_core_predict, qg_core_update;
extern int qg_core_take(void *, void *, void *, int64_t, int64_t, int64_t, int64_t, void *, void *);
extern int qg_core_prepare(void *, void *, void *, void *);
extern int qg_core_start(void *, void *, void *, void *, const void *, void *, void *, void *);
extern int qg_core_keep(void *, void *, const void *, int64_t);
extern const char qg_core_params[], qg_core_steps[], qg_core_settings[], qg_core_first[],
    qg_core_fix[];
@STAGE_DECLARATIONS@

/* The address of the full record, of which only the used parts are in memory. */
static char *qgi_flight(const qg_filter *f)
{
    return (char *)(uintptr_t)f->flight - @SKIPPED@;
}

static double *qgi_field(const qg_filter *f, int offset)
{
    return (double *)(void *)(qgi_flight(f) + offset);
}

/* Copy n numbers; return 0 without any. */
static int qgi_put(double *to, const double *from, int n)
{
    for (int i = 0; from && i < n; i++)
        to[i] = from[i];
    return from != 0;
}

/* ---- one operation of the filter ---- */

static void qgi_run_on(qg_filter *f, qgi_run *run, const void *input)
{
    void *result, *raised;
    run(&result, &raised, qgi_flight(f), f->params, qg_core_params, f->steps, qg_core_settings,
        f->work, f->table, input);
}

static const int qgi_parts[][2] = {@COPIED@}; /* offsets and lengths of what is copied, in doubles */

static void qgi_copy(qg_filter *f, double *copy, int restores)
{
    for (unsigned k = 0; k < sizeof qgi_parts / sizeof qgi_parts[0]; k++) {
        double *part = f->flight + qgi_parts[k][0];
        size_t size = 8 * (size_t)qgi_parts[k][1];
        if (restores)
            memcpy(part, copy, size);
        else
            memcpy(copy, part, size);
        copy += qgi_parts[k][1];
    }
}

/* ---- inputs ---- */

static int64_t qgi_address(const void *place)
{
    return (int64_t)(uintptr_t)place;
}

/* Take an input into the window, and run the operations that process it. */
static int qgi_take(qg_filter *f, qg_input_record *input, qg_measurement_record *measured)
{
    void *result, *raised;
    if (!f->started)
        return QG_NOT_STARTED;
    qg_core_take(&result, &raised, &f->window, qgi_address(f->event), qgi_address(f->sample),
                 qgi_address(f->waits), qgi_address(f->operation), input, measured);
    if (input->rank && input->outcome == QG_OK)
        f->measurement[input->index] = *measured;
    for (int k = 0; k < f->window.operations; k++) {
        const qg_operation_record *o = &f->operation[k];
        if (o->code == @PREDICT@)
            qgi_run_on(f, qg_core_predict, &f->sample[o->index]);
        else if (o->code == @UPDATE@)
            qgi_run_on(f, qg_core_update, &f->measurement[o->index]);
        else
            qgi_copy(f, f->copy[o->target], o->code == @RESTORE@);
    }
    f->window.operations = 0;
    return (int)input->outcome;
}

int qg_predict(qg_filter *f, const double gyro[3], const double accel[3], double dt)
{
    qg_input_record input;
    memset(&input, 0, sizeof input);
    qgi_put(input.gyro, gyro, 3);
    qgi_put(input.accel, accel, 3);
    input.dt = dt;
    return qgi_take(f, &input, f->measurement);
}

double qg_time(const qg_filter *f)
{
    return f->window.time;
}

double qg_oldest_time(const qg_filter *f)
{
    double reach = f->window.time - f->window.length;
    if (!f->window.events)
        return f->window.time;
    return reach > f->event[0].start ? reach : f->event[0].start;
}

int qg_update(qg_filter *f, const qg_measurements *m, double time)
{
    qg_measurement_record r;
    qg_input_record input;
    memset(&r, 0, sizeof r);
    memset(&input, 0, sizeof input);
@TAKE@@IF CAMERA@
    for (int i = 0; m->pixels && i < QG_FEATURES; i++) {
        qgi_put(r.pixels[i], m->pixels + 2 * i, 2);
        r.valid[@FEATURE_BLOCKS@ + i] = !isnan(r.pixels[i][0]) && !isnan(r.pixels[i][1]);
    }
    r.pixel_sigma = m->pixel_sigma;
@END@
    input.time = time;
    input.rank = @RANK@; /* as in a replay */
    return qgi_take(f, &input, &r);
}

@SOURCE@/* ---- start ---- */

static int qgi_init(qg_filter *f, qg_fix_record *fix)
{
    void *result, *raised;
    qg_start_record first;
    memcpy(&first, qg_core_first, sizeof first);
    qg_core_prepare(&result, &raised, &first, fix);
    if (fix->outcome)
        return (int)fix->outcome;
    memset(f, 0, sizeof *f);
    memcpy(f->params, qg_core_params, sizeof f->params);
    memcpy(f->steps, qg_core_steps, sizeof f->steps);
@FILL_TABLE@
    *(double *)(void *)((char *)f->work + @OF_MASK@) = 1.0;
    f->window.time = fix->time;
    f->window.length = QG_WINDOW;
    f->window.longest = f->window.ahead = QG_LONGEST_STEP;
    f->window.copy_every = QG_COPY_EVERY;
    f->window.event_room = QG_EVENTS;
    f->window.waiting_room = QG_WAITING;
    f->window.room[@A_SAMPLE@] = sizeof f->sample / sizeof f->sample[0];
    f->window.room[@A_MEASUREMENT@] = sizeof f->measurement / sizeof f->measurement[0];
    f->window.room[@A_COPY@] = QG_COPIES;
    qg_core_start(&result, &raised, qgi_flight(f), f->params, qg_core_settings, f->work, &first,
                  fix);
    f->started = 1;
    return QG_OK;
}

int qg_init_at_rest(qg_filter *f, const double position[3], double heading, double time)
{
    qg_fix_record fix;
    memcpy(&fix, qg_core_fix, sizeof fix);
    fix.rest = 1;
    fix.has_position = qgi_put(fix.position, position, 3);
    fix.has_heading = qgi_put(&fix.heading, &heading, 1);
    fix.time = time;
    return qgi_init(f, &fix);
}

@IF BAROMETER@
void qg_barometer_from_start(qg_filter *f)
{
    *(double *)(void *)((char *)f->steps + @OF_LEVEL@) = NAN;
}

@END@
@IF GNSS@
int qg_init(qg_filter *f, const qg_start *s)
{
    qg_fix_record fix;
    memcpy(&fix, qg_core_fix, sizeof fix);
    fix.time = s->time;
    fix.has_position = qgi_put(fix.position, s->gnss_position, 3);
    qgi_put(fix.sigma, s->gnss_sigma, 3);
    fix.has_baseline = qgi_put(fix.baseline, s->gnss_baseline, 3);
    fix.has_velocity = qgi_put(fix.velocity, s->gnss_velocity, 3);
    fix.has_heading = qgi_put(&fix.heading, s->heading, 1);
    fix.has_field = qgi_put(fix.field_B, s->magnetometer, 3);
    fix.course = s->course;
    qgi_put(&fix.velocity_sigma, s->velocity_sigma > 0.0 ? &s->velocity_sigma : 0, 1);
    qgi_put(&fix.field_sigma, s->magnetometer_sigma > 0.0 ? &s->magnetometer_sigma : 0, 1);
    fix.tilt_sigma = s->tilt_sigma;
    fix.rest_sigma = s->rest_sigma;
    return qgi_init(f, &fix);
}

@END@
/* ---- outputs ---- */

static void qgi_quaternion(const double R[9], double q[4])
{
    const double a = R[0], b = R[1], c = R[2], d = R[3], e = R[4], f = R[5], g = R[6], h = R[7],
                 i = R[8];
    const double rows[4][4] = {{1.0 + a + e + i, f - h, g - c, b - d},
                               {f - h, 1.0 + a - e - i, b + d, g + c},
                               {g - c, b + d, 1.0 - a + e - i, f + h},
                               {b - d, g + c, f + h, 1.0 - a - e + i}};
    int k = 0;
    const double *r;
    double size;
    for (int j = 1; j < 4; j++)
        if (rows[j][j] > rows[k][k])
            k = j;
    r = rows[k];
    size = sqrt(r[0] * r[0] + r[1] * r[1] + r[2] * r[2] + r[3] * r[3]);
    for (int j = 0; j < 4; j++)
        q[j] = r[j] / size;
}

int qg_state(const qg_filter *f, qg_estimate *estimate)
{
    double row[@KEPT@];
    void *result, *raised;
    if (!f->started)
        return QG_NOT_STARTED;
    qg_core_keep(&result, &raised, qgi_flight(f), (int64_t)(uintptr_t)row);
    estimate->time = f->window.time;
    memcpy(estimate->position, row, 3 * 8);
    memcpy(estimate->velocity, row + 3, 3 * 8);
    memcpy(estimate->R_BI, row + 6, 9 * 8);
    memcpy(estimate->accel_bias, row + 15, 3 * 8);
    memcpy(estimate->gyro_bias, row + 18, 3 * 8);
    for (int i = 0; i < 15; i++)
        estimate->sigma[i] = sqrt(row[21 + i]);
    estimate->diverged = row[36] > 0.0;
    qgi_quaternion(estimate->R_BI, estimate->quaternion);
    return QG_OK;
}

int qg_covariance(const qg_filter *f, double covariance[225])
{
    const double *L = qgi_field(f, @OF_L@);
    if (!f->started)
        return QG_NOT_STARTED;
    for (int i = 0; i < 15; i++)
        for (int j = 0; j < 15; j++) {
            double sum = 0.0;
            for (int k = 0; k <= (i < j ? i : j); k++)
                sum += L[15 * i + k] * L[15 * j + k];
            covariance[15 * i + j] = sum;
        }
    return QG_OK;
}

unsigned qg_status(const qg_filter *f)
{
    return f->started ? (unsigned)*(const uint64_t *)(const void *)qgi_field(f, @OF_STATUS@) : 0;
}
@IF POLICY@

static float *qgi_seen(float *o, const double R[9], const double x[3], const double y[3])
{
    for (int i = 0; i < 3; i++)
        *o++ = (float)(R[3 * i] * (x[0] - y[0]) + R[3 * i + 1] * (x[1] - y[1]) +
                       R[3 * i + 2] * (x[2] - y[2]));
    return o;
}

int qg_action(qg_filter *f, const qg_reference *reference, float action[4])
{
    static const double zero[3] = {0.0, 0.0, 0.0}, up[3] = {0.0, 0.0, 1.0};
    float observation[@SIZE@], *o = observation, found[4];
    qg_estimate e;
    if (qg_state(f, &e) != QG_OK || !f->window.has_gyro)
        return QG_NOT_STARTED;
    (void)zero, (void)up;
    @FIELDS@
    if (qg_policy(observation, found))
        return QG_NOT_FINITE;
    for (int i = 0; i < 4; i++)
        action[i] = f->last_action[i] = found[i];
    return QG_OK;
}
@END@

#ifdef __cplusplus
}
#endif

#if defined(__GNUC__) && !defined(__clang__)
#pragma GCC pop_options
#endif
