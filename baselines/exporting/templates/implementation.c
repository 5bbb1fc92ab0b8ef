#include <math.h>
#include <string.h>

#ifdef __cplusplus
extern "C" {
#endif

#define QGI_STAGE(name) \
    extern int name(void *, void *, void *, void *, void *, void *, void *, void *, int64_t)

extern int qg_core_take(void *, void *, void *, void *, const void *, void *, const void *, void *,
                        void *, void *, const void *, int64_t, const void *, void *, void *);
extern int qg_core_state(void *, void *, void *, const void *, int64_t, void *);
extern int qg_core_covariance(void *, void *, void *, int64_t);
extern int qg_core_seen(void *, void *, int64_t, int64_t, int64_t, int64_t);
extern int qg_core_prepare(void *, void *, void *, void *, const void *);
extern int qg_core_start(void *, void *, void *, void *, const void *, void *, void *, void *);
extern const char qg_core_params[], qg_core_steps[], qg_core_settings[], qg_core_first[],
    qg_core_fix[], qg_core_parts[], qg_core_mounting[];
@STAGE_DECLARATIONS@
@IF FMA@

/* ---- a b + c, rounded once, as an exact sum of four numbers (Boldo and Melquiond 2008) ---- */

double qg_core_fma(double a, double b, double c);

static double qgi_sum(double a, double b, double *error)
{
    double sum = a + b, part = sum - a;
    *error = (a - (sum - part)) + (b - part);
    return sum;
}

/* a + b; an inexact sum has an odd last bit. */
static double qgi_odd_sum(double a, double b)
{
    double error, sum = qgi_sum(a, b, &error);
    int64_t bits;
    memcpy(&bits, &sum, sizeof bits);
    if (error != 0.0 && !(bits & 1))
        bits += (error > 0.0) == (sum > 0.0) ? 1 : -1;
    memcpy(&sum, &bits, sizeof bits);
    return sum;
}

/* For results that are normal numbers. */
double qg_core_fma(double a, double b, double c)
{
    static const double split = 134217729.0; /* 2^27 + 1 */
    int i, j, k;
    double x = frexp(a, &i), y = frexp(b, &j), z = frexp(c, &k);
    if (!isfinite(a) || !isfinite(b) || !isfinite(c) || a == 0.0 || b == 0.0)
        return a * b + c;
    k -= i + j;
    if (k > 150)
        return c;
    double p = x * y, x0 = split * x - (split * x - x), y0 = split * y - (split * y - y);
    double rest = ((x0 * y0 - p) + x0 * (y - y0) + (x - x0) * y0) + (x - x0) * (y - y0);
    double low, lower, sum = qgi_sum(ldexp(z, k < -150 ? -150 : k), rest, &lower);
    sum = qgi_sum(p, sum, &low);
    return ldexp(sum + qgi_odd_sum(lower, low), i + j);
}
@END@

/* The address of the full record, of which only the used parts are in memory. */
static char *qgi_flight(const qg_filter *f)
{
    return (char *)((uintptr_t)f->flight - @SKIPPED@);
}

/* Copy n numbers; return 0 without any. */
#define QGI_PUT(name, to_type, from_type)                            \
    static int name(to_type *to, const from_type *from, int n)       \
    {                                                                \
        for (int i = 0; from && i < n; i++)                          \
            to[i] = (to_type)from[i];                                \
        return from != 0;                                            \
    }
QGI_PUT(qgi_put, double, double)
QGI_PUT(qgi_sample, double, qg_real)
QGI_PUT(qgi_value, qg_real, qg_real)
@IF GNSS@
QGI_PUT(qgi_place, qg_real, double)

static int qgi_rounded(double *to, const double *from, int n)
{
    for (int i = 0; from && i < n; i++) {
        volatile qg_real number = (qg_real)from[i]; /* GCC 12 would not round pairs of them */
        to[i] = (double)number;
    }
    return from != 0;
}
@END@

static int64_t qgi_address(const void *place) { return (int64_t)(uintptr_t)place; }

/* ---- inputs ---- */

static int qgi_take(qg_filter *f, qg_input_record *input, qg_measurement_record *measured)
{
    const qg_memory_record memory = {qgi_address(f->event), qgi_address(f->sample),
                                     qgi_address(f->waits), qgi_address(f->operation),
                                     qgi_address(f->measurement), qgi_address(f->copy),
                                     @COPY_WORDS@, qgi_address(f->flight)};
    void *result, *raised;
    if (!f->started)
        return QG_NOT_STARTED;
    qg_core_take(&result, &raised, qgi_flight(f), f->params, qg_core_params, f->steps,
                 qg_core_settings, f->work, f->table, &f->window, &memory,
                 qgi_address(qg_core_parts), qg_core_mounting, input, measured);
    return (int)input->outcome;
}

int qg_predict(qg_filter *f, const qg_real gyro[3], const qg_real accel[3], double dt)
{
    qg_input_record input = {0};
    qgi_sample(input.gyro, gyro, 3);
    qgi_sample(input.accel, accel, 3);
    input.dt = dt;
    return qgi_take(f, &input, f->measurement);
}

double qg_time(const qg_filter *f) { return f->window.time; }

double qg_oldest_time(const qg_filter *f) { return f->window.oldest; }

int qg_update(qg_filter *f, const qg_measurements *m, double time)
{
    qg_measurement_record r = {0};
    qg_input_record input = {0};
@TAKE@    input.time = time;
    input.rank = @RANK@; /* as in a replay */
    return qgi_take(f, &input, &r);
}

@SOURCE@/* ---- start ---- */

static int qgi_init(qg_filter *f, qg_fix_record *fix)
{
    void *result, *raised;
    qg_start_record first;
    memcpy(&first, qg_core_first, sizeof first);
    qg_core_prepare(&result, &raised, &first, fix, qg_core_mounting);
    if (fix->outcome)
        return (int)fix->outcome;
    memset(f, 0, sizeof *f);
    memcpy(f->params, qg_core_params, sizeof f->params);
    memcpy(f->steps, qg_core_steps, sizeof f->steps);
@FILL_TABLE@
    f->window.time = f->window.oldest = fix->time;
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
    *(qg_real *)(void *)((char *)f->steps + @OF_LEVEL@) = NAN;
}

@END@
@IF GNSS@
int qg_init(qg_filter *f, const qg_start *s)
{
    qg_fix_record fix;
    memcpy(&fix, qg_core_fix, sizeof fix);
    fix.time = s->time;
    fix.has_position = qgi_rounded(fix.position, s->gnss_position, 3);
    qgi_rounded(fix.sigma, s->gnss_sigma, 3);
    fix.has_baseline = qgi_rounded(fix.baseline, s->gnss_baseline, 3);
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

int qg_state(const qg_filter *f, qg_estimate *estimate)
{
    double row[@KEPT@] = {0.0};
    void *result, *raised;
    if (!f->started)
        return QG_NOT_STARTED;
    qg_core_state(&result, &raised, qgi_flight(f), &f->window, qgi_address(row), estimate);
    return QG_OK;
}

int qg_covariance(const qg_filter *f, double covariance[225])
{
    void *result, *raised;
    if (!f->started)
        return QG_NOT_STARTED;
    qg_core_covariance(&result, &raised, qgi_flight(f), qgi_address(covariance));
    return QG_OK;
}

unsigned qg_status(const qg_filter *f)
{
    return f->started ? (unsigned)*(const uint64_t *)(const void *)(qgi_flight(f) + @OF_STATUS@) : 0;
}
@IF POLICY@

static float *qgi_seen(float *o, const double R[9], const double x[3], const double y[3])
{
    void *result, *raised;
    qg_core_seen(&result, &raised, qgi_address(o), qgi_address(R), qgi_address(x), qgi_address(y));
    return o + 3;
}

int qg_action(qg_filter *f, const qg_reference *reference, float action[4])
{
    static const double zero[3] = {0.0, 0.0, 0.0}, up[3] = {0.0, 0.0, 1.0};
    float observation[@SIZE@] = {0.0f}, *o = observation, found[4];
    qg_estimate s;
    struct {
        double position[3], velocity[3], R_BI[9], gyro_bias[3], sigma[15];
    } e;
    if (qg_state(f, &s) != QG_OK || !f->window.has_gyro)
        return QG_NOT_STARTED;
    qgi_put(e.position, s.position, 3);
    qgi_sample(e.velocity, s.velocity, 3);
    qgi_sample(e.R_BI, s.R_BI, 9);
    qgi_sample(e.gyro_bias, s.gyro_bias, 3);
    qgi_sample(e.sigma, s.sigma, 15);
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
