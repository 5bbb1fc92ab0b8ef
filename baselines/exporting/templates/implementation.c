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
extern int qg_core_take(void *, void *, void *, int64_t, int64_t, int64_t, int64_t, void *);
extern int qg_core_start(void *, void *, void *, void *, const void *, void *, const void *);
extern int qg_core_start_level(void *, void *, void *);
extern int qg_core_keep(void *, void *, const void *, int64_t);
extern const char qg_core_params[], qg_core_steps[], qg_core_settings[], qg_core_first[];
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

static int qgi_finite(const double *x, int n)
{
    for (int i = 0; i < n; i++)
        if (!isfinite(x[i]))
            return 0;
    return 1;
}

#ifdef QG_GNSS
static void qgi_turn(const double m[9], const double v[3], double out[3])
{
    for (int i = 0; i < 3; i++)
        out[i] = m[3 * i] * v[0] + m[3 * i + 1] * v[1] + m[3 * i + 2] * v[2];
}
#endif

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
static int qgi_take(qg_filter *f, qg_input_record *input, const qg_measurement_record *measured)
{
    void *result, *raised;
    qg_core_take(&result, &raised, &f->window, qgi_address(f->event), qgi_address(f->sample),
                 qgi_address(f->waits), qgi_address(f->operation), input);
    if (measured && input->outcome == QG_OK)
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
    if (!f->started)
        return QG_NOT_STARTED;
    if (!qgi_finite(gyro, 3) || !qgi_finite(accel, 3) || !isfinite(dt))
        return QG_NOT_FINITE;
    memset(&input, 0, sizeof input);
    memcpy(input.gyro, gyro, sizeof input.gyro);
    memcpy(input.accel, accel, sizeof input.accel);
    input.dt = dt;
    return qgi_take(f, &input, 0);
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

/* The noise of a measurement: standard deviations of at least a limit. */
static int qgi_noise(const double *measured, const double *sigma, int n, double least, double *out)
{
    if (!measured)
        return QG_CONTRADICTION;
    for (int i = 0; i < n; i++) {
        if (!isfinite(sigma[i]))
            return QG_NOT_FINITE;
        if (sigma[i] < least)
            return QG_OUT_OF_RANGE;
        out[i] = sigma[i];
    }
    return QG_OK;
}

/* The numbers of a measurement; NULL: not measured. */
static int qgi_block(const double *given, int n, double *valid, double *place)
{
    if (!given)
        return QG_OK;
    if (!qgi_finite(given, n))
        return QG_NOT_FINITE;
    *valid = 1.0;
    memcpy(place, given, 8 * (size_t)n);
    return QG_OK;
}

#ifdef QG_GNSS
/* Scale a baseline by a power of two: its length is not used. */
static int qgi_baseline(const double *given, double out[3])
{
    double largest = 0.0;
    int exponent;
    if (!qgi_finite(given, 3))
        return QG_NOT_FINITE;
    for (int i = 0; i < 3; i++)
        largest = fabs(given[i]) > largest ? fabs(given[i]) : largest;
    if (largest == 0.0)
        return QG_OUT_OF_RANGE;
    frexp(largest, &exponent);
    for (int i = 0; i < 3; i++)
        out[i] = ldexp(given[i], -exponent);
    return QG_OK;
}
#endif

int qg_update(qg_filter *f, const qg_measurements *m, double time)
{
    qg_measurement_record r;
    qg_input_record input;
    int error = QG_OK;
    if (!f->started)
        return QG_NOT_STARTED;
    if (!isfinite(time))
        return QG_NOT_FINITE;
    memset(&r, 0, sizeof r);
@BLANK@
@AID_TAKE@@IF CAMERA@
    for (int i = 0; !error && m->pixels && i < QG_FEATURES; i++) {
        const double *pixel = m->pixels + 2 * i;
        if (!isnan(pixel[0]) && !isnan(pixel[1]))
            error = qgi_block(pixel, 2, &r.valid[@FEATURE_BLOCKS@ + i], r.pixels[i]);
    }
    if (!error && m->pixel_sigma != 0.0)
        error = qgi_noise(m->pixels, &m->pixel_sigma, 1, 1e-12, &r.pixel_sigma);
@END@
@IF GNSS@
    if (!error)
        error = qgi_block(m->gnss_position, 3, &r.valid[@POSITION_BLOCK@], r.gnss_position);
    if (!error && m->gnss_sigma)
        error = qgi_noise(m->gnss_position, m->gnss_sigma, 3, 1e-9, r.position_sigma_I);
@END@
@IF BASELINE@
    if (!error && m->gnss_baseline) {
        error = qgi_baseline(m->gnss_baseline, r.gnss_baseline);
        r.valid[@BASELINE_BLOCK@] = 1.0;
    }
    if (!error && m->baseline_sigma != 0.0) {
        error = qgi_noise(m->gnss_baseline, &m->baseline_sigma, 1, 1e-12, &r.baseline_sigma);
        if (r.baseline_sigma > 3.141592653589793)
            r.baseline_sigma = 3.141592653589793;
        r.baseline_noise = r.baseline_sigma;
    }
@END@
@IF VELOCITY@
    if (!error)
        error = qgi_block(m->gnss_velocity, 3, &r.valid[@VELOCITY_BLOCK@], r.gnss_velocity);
    if (!error && m->velocity_sigma != 0.0)
        error = qgi_noise(m->gnss_velocity, &m->velocity_sigma, 1, 1e-12, &r.velocity_sigma);
@END@
    if (error)
        return error;
    memset(&input, 0, sizeof input);
    input.time = time;
    input.rank = @RANK@; /* as in a replay */
    return qgi_take(f, &input, &r);
}

@AID_SOURCE@@IF CAMERA@
int qg_update_pixels(qg_filter *f, const double *pixels, double time)
{
    qg_measurements m;
    memset(&m, 0, sizeof m);
    m.pixels = pixels;
    return qg_update(f, &m, time);
}

@END@
@IF GNSS@
int qg_update_gnss_position(qg_filter *f, const double position[3], const double *sigma,
                            double time)
{
    qg_measurements m;
    memset(&m, 0, sizeof m);
    m.gnss_position = position;
    m.gnss_sigma = sigma;
    return qg_update(f, &m, time);
}

@END@
@IF BASELINE@
int qg_update_gnss_baseline(qg_filter *f, const double baseline[3], double time)
{
    qg_measurements m;
    memset(&m, 0, sizeof m);
    m.gnss_baseline = baseline;
    return qg_update(f, &m, time);
}

@END@
@IF VELOCITY@
int qg_update_gnss_velocity(qg_filter *f, const double velocity[3], double sigma,
                            double time)
{
    qg_measurements m;
    memset(&m, 0, sizeof m);
    m.gnss_velocity = velocity;
    m.velocity_sigma = sigma;
    return qg_update(f, &m, time);
}

@END@
/* ---- start ---- */

static void qgi_begin(qg_filter *f, double time)
{
    memset(f, 0, sizeof *f);
    memcpy(f->params, qg_core_params, sizeof f->params);
    memcpy(f->steps, qg_core_steps, sizeof f->steps);
    memcpy(&f->first, qg_core_first, sizeof f->first);
@FILL_TABLE@
    *(double *)(void *)((char *)f->work + @OF_MASK@) = 1.0;
    f->window.time = time;
    f->window.length = QG_WINDOW;
    f->window.longest = f->window.ahead = QG_LONGEST_STEP;
    f->window.copy_every = QG_COPY_EVERY;
    f->window.event_room = QG_EVENTS;
    f->window.waiting_room = QG_WAITING;
    f->window.room[@A_SAMPLE@] = sizeof f->sample / sizeof f->sample[0];
    f->window.room[@A_MEASUREMENT@] = sizeof f->measurement / sizeof f->measurement[0];
    f->window.room[@A_COPY@] = QG_COPIES;
}

static void qgi_start(qg_filter *f)
{
    void *result, *raised;
    for (int i = 0; i < 3; i++)
        qgi_field(f, @OF_W_BEFORE@)[i] = NAN;
    qg_core_start(&result, &raised, qgi_flight(f), f->params, qg_core_settings, f->work, &f->first);
    f->started = 1;
}

int qg_init_at_rest(qg_filter *f, const double position[3], double heading, double time)
{
    static const double sigma[15] = {@REST_SIGMA@};
    double *R, *L;
    if (!qgi_finite(position, 3) || !isfinite(heading) || !isfinite(time))
        return QG_NOT_FINITE;
    qgi_begin(f, time);
    qgi_start(f);
    R = qgi_field(f, @OF_R_HAT@);
    L = qgi_field(f, @OF_L@);
    R[0] = R[4] = cos(heading);
    R[1] = sin(heading);
    R[3] = -R[1];
    R[2] = R[5] = R[6] = R[7] = 0.0;
    R[8] = 1.0;
    for (int i = 0; i < 3; i++) {
        qgi_field(f, @OF_POSITION@)[i] = position[i];
        qgi_field(f, @OF_VELOCITY@)[i] = qgi_field(f, @OF_ACCEL_BIAS@)[i] = 0.0;
        qgi_field(f, @OF_GYRO_BIAS@)[i] = 0.0;
    }
    for (int i = 0; i < 15; i++)
        for (int j = 0; j < 15; j++)
            L[15 * i + j] = i == j ? sigma[i] : 0.0;
    return QG_OK;
}

@IF BAROMETER@
void qg_barometer_from_start(qg_filter *f)
{
    *(double *)(void *)((char *)f->steps + @OF_LEVEL@) = NAN;
}

@END@
@IF GNSS@
/* Heading by the magnetometer of a level vehicle. */
static int qgi_magnetic(qg_start_record *s, const double field[3], double white)
{
#ifdef QG_MAGNETOMETER
    static const double m_I[3] = {@FIELD_I@};
    const double cross[3] = {m_I[1], -m_I[0], 0.0};
    double angle, R[9] = {0}, f[3], g[3], f_h, u[2], t[2];
    double strength = sqrt(field[0] * field[0] + field[1] * field[1]);
    if (!qgi_finite(field, 3))
        return QG_NOT_FINITE;
    if (strength < 1e-3 * @STRENGTH@)
        return QG_OUT_OF_RANGE;
    angle = atan2(m_I[1], m_I[0]) - atan2(field[1], field[0]);
    R[0] = R[4] = cos(angle);
    R[1] = sin(angle);
    R[3] = -R[1];
    R[8] = 1.0;
    qgi_turn(R, m_I, f);
    qgi_turn(R, cross, g);
    f_h = sqrt(f[0] * f[0] + f[1] * f[1]);
    u[0] = f[0] / f_h;
    u[1] = f[1] / f_h;
    t[0] = -u[1];
    t[1] = u[0];
    s->heading = angle;
    s->heading_sigma = (white > 0.0 ? white : @FIELD_SIGMA@) / f_h;
    s->heading_of_slow[@IRON@] = t[0] / f_h;
    s->heading_of_slow[@IRON@ + 1] = t[1] / f_h;
    s->heading_of_slow[@DECLINATION@] = (t[0] * g[0] + t[1] * g[1]) / f_h;
    s->heading_of_tilt[0] = f[2] * u[0] / f_h;
    s->heading_of_tilt[1] = f[2] * u[1] / f_h;
    return QG_OK;
#else
    (void)s, (void)field, (void)white;
    return QG_CONTRADICTION;
#endif
}

/* Heading of a vehicle that flies nose first. */
static int qgi_course(qg_start_record *s, const double velocity[3], double sigma)
{
    double speed = sqrt(velocity[0] * velocity[0] + velocity[1] * velocity[1]), across;
    if (speed < @MIN_COURSE@ * sigma)
        return QG_OUT_OF_RANGE;
    across = sigma / speed;
    s->heading = atan2(velocity[1], velocity[0]);
    s->heading_sigma = sqrt(s->heading_sigma * s->heading_sigma + across * across);
    return QG_OK;
}

/* The first estimate of a level vehicle, in place of the one by Wahba's problem. */
static void qgi_level(qg_filter *f)
{
    const qg_start_record *s = &f->first;
    const int n = 15 + (int)s->slow_states;
    void *result, *raised;
    qg_core_start_level(&result, &raised, &f->first);
    memcpy(qgi_field(f, @OF_POSITION@), s->position, sizeof s->position);
    memcpy(qgi_field(f, @OF_R_HAT@), s->R_BI, sizeof s->R_BI);
    for (int i = 0; i < n; i++)
        for (int j = 0; j < n; j++) {
            if (i >= 15)
                qgi_field(f, @OF_L_SLOW@)[@L_SLOW_PITCH@ * (i - 15) + j] = s->factor[i][j];
            else if (j < 15)
                qgi_field(f, @OF_L@)[15 * i + j] = s->factor[i][j];
        }
}

/* A number of the parameters. */
static double *qgi_number(qg_filter *f, int place)
{
    return (double *)(void *)((char *)f->params + place);
}

int qg_init(qg_filter *f, const qg_start *s)
{
    static const double R_IG[9] = {@R_IG@};
    const int headings = (s->heading != 0) + (s->magnetometer != 0) + (s->course != 0);
    const double *suite;
    qg_start_record first;
    double baseline[3] = {1.0, 0.0, 0.0}, velocity[3] = {0.0, 0.0, 0.0}, sigmas[3];
    double speed_sigma = s->velocity_sigma > 0.0 ? s->velocity_sigma : @VELOCITY_SIGMA@;
    double tilt_sigma, velocity_variance;
    int error = QG_OK;
    memcpy(&first, qg_core_first, sizeof first);
    if (!s->gnss_position || !qgi_finite(s->gnss_position, 3) || !isfinite(s->time))
        return QG_NOT_FINITE;
    for (int i = 0; i < 3; i++)
        if (fabs(s->gnss_position[i]) > @FARTHEST@)
            return QG_OUT_OF_RANGE;
    suite = (const double *)(const void *)(qg_core_params + @OF_POSITION_SIGMA@);
    memcpy(sigmas, suite, sizeof sigmas);
    if (s->gnss_sigma && (error = qgi_noise(s->gnss_position, s->gnss_sigma, 3, 1e-9, sigmas)))
        return error;
    if (!(s->tilt_sigma >= 0.0 && s->tilt_sigma <= 1.0 && s->rest_sigma >= 0.0) ||
        isinf(s->rest_sigma))
        return QG_OUT_OF_RANGE;
    if (s->tilt_sigma > 0.0)
        first.tilt_sigma = s->tilt_sigma;
    for (int i = 0; i < 3 && s->rest_sigma > 0.0; i++)
        first.velocity_sigma[i] = s->rest_sigma;
    if (s->gnss_velocity) {
        if (!qgi_finite(s->gnss_velocity, 3))
            return QG_NOT_FINITE;
        if (!(speed_sigma > 0.0))
            return QG_OUT_OF_RANGE;
        qgi_turn(R_IG, s->gnss_velocity, velocity);
        for (int i = 0; i < 3; i++)
            first.velocity_sigma[i] = speed_sigma;
    }
    if (s->heading && !isfinite(*s->heading))
        return QG_NOT_FINITE;
    if (s->gnss_baseline) {
        if (!@HAS_BASELINE@ || s->magnetometer || s->course)
            return QG_CONTRADICTION;
        error = qgi_baseline(s->gnss_baseline, baseline);
        if (s->heading) {
            first.x_I[0] = cos(*s->heading);
            first.x_I[1] = sin(*s->heading);
        }
    } else if (headings != 1) {
        return headings ? QG_CONTRADICTION : QG_NO_HEADING;
    } else if (s->heading) {
        first.heading = *s->heading;
    } else if (s->magnetometer) {
        error = qgi_magnetic(&first, s->magnetometer, s->magnetometer_sigma);
    } else {
        error = s->gnss_velocity ? qgi_course(&first, velocity, speed_sigma) : QG_CONTRADICTION;
    }
    if (error)
        return error;
    qgi_begin(f, s->time);
    tilt_sigma = *qgi_number(f, @OF_TILT_SIGMA@);
    velocity_variance = *qgi_number(f, @OF_VELOCITY_VARIANCE@);
    f->first = first;
    qgi_turn(R_IG, s->gnss_position, f->first.antenna_I);
    for (int i = 0; i < 3; i++) {
        qgi_field(f, @OF_GNSS_POSITION@)[i] = s->gnss_position[i];
        qgi_field(f, @OF_GNSS_BASELINE@)[i] = baseline[i];
        f->first.position_root[i][i] = @ROOT_SCALE@ * sigmas[i];
        qgi_number(f, @OF_POSITION_SIGMA@)[i] = sigmas[i];
    }
    if (s->tilt_sigma > 0.0)
        *qgi_number(f, @OF_TILT_SIGMA@) = s->tilt_sigma;
    if (s->rest_sigma > 0.0)
        *qgi_number(f, @OF_VELOCITY_VARIANCE@) = s->rest_sigma * s->rest_sigma;
    qgi_start(f);
    *qgi_number(f, @OF_TILT_SIGMA@) = tilt_sigma;
    *qgi_number(f, @OF_VELOCITY_VARIANCE@) = velocity_variance;
    memcpy((char *)f->params + @OF_POSITION_SIGMA@, suite, 3 * 8);
    if (!s->gnss_baseline)
        qgi_level(f);
    if (s->gnss_velocity || !s->gnss_baseline)
        memcpy(qgi_field(f, @OF_VELOCITY@), velocity, sizeof velocity);
    if (s->gnss_velocity && s->gnss_baseline)
        for (int i = 3; i < 6; i++)
            qgi_field(f, @OF_L@)[16 * i] = speed_sigma;
    return QG_OK;
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
