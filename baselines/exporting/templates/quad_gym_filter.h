/* @TITLE@
 *
 * For: @TARGET@.
 *
 * The filter with which a controller was trained: a static library of its compiled kernels
 * (libquad_gym_filter.a), and this header. The estimates are bitwise those of `quad-gym replay` in
 * @PRECISION@ precision.
 * One .c file of your program defines QUAD_GYM_FILTER_IMPLEMENTATION before it includes this
 * header; link it with libquad_gym_filter.a and the math library.
 *
 * SI units. I: inertial, east, north, up, from the reference antenna; G: Earth-centered (ECEF);
 * B: body, x ahead, y left, z up. Vectors have 3 numbers. Times are time stamps with one common
 * zero. No function allocates memory; all memory of a filter is its `qg_filter`, for which a static
 * variable is the right place: about @RAM@ bytes. Filters are independent of each other.
 *
 * A call that returns an error has changed nothing. */
#ifndef QUAD_GYM_FILTER_H
#define QUAD_GYM_FILTER_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

typedef @REAL@ qg_real; /* of samples, measurements and estimates; times and places are double */

enum qg_result {
@OUTCOMES@};

#define QG_TICK @TICK@ /* period of the IMU for which the noise is stated [s] */
#define QG_IMU_AVERAGES @AVERAGES@ /* 1: IMU samples are means over their time; 0: values at its start */
#define QG_LONGEST_STEP @LONGEST@ /* longest time of one prediction [s] */
#ifndef QG_WINDOW
#define QG_WINDOW @WINDOW@ /* longest delay of a measurement [s] */
#endif
#ifndef QG_COPY_EVERY
#define QG_COPY_EVERY @COPY_EVERY@ /* inputs between two copies of the filter; fewer copies: less memory, and
                         * more time for a delayed measurement */
#endif
#ifndef QG_EVENTS
#define QG_EVENTS @EVENTS@ /* samples and measurements within the window */
#endif
#ifndef QG_MEASUREMENTS
#define QG_MEASUREMENTS @MEASUREMENTS@ /* measurements among them */
#endif
#ifndef QG_WAITING
#define QG_WAITING @WAITING@ /* measurements that may wait for later samples */
#endif
#define QG_COPIES (QG_EVENTS / QG_COPY_EVERY + 2)
@MACROS@
typedef struct qg_filter qg_filter; /* see the end of this header */

/* ---- start ---- */
@IF GNSS@
/* A first fix; NULL: not measured. Without a baseline the vehicle is assumed level, and its heading
 * comes from exactly one of heading, magnetometer and course. */
typedef struct {
    double time;                 /* its time stamp [s] */
    const double *gnss_position; /* primary antenna minus reference antenna, in G [m] */
    const double *gnss_sigma;    /* 3 standard deviations of it in I [m]; NULL: the suite's */
    const double *gnss_baseline; /* primary to secondary antenna, in G [m] */
    const double *gnss_velocity; /* in G [m/s]; NULL: at rest */
    double velocity_sigma;       /* [m/s]; 0: the suite's */
    const double *heading;       /* of body x, from east toward north [rad] */
    const double *magnetometer;  /* magnetic field in the axes of its sensor [T] */
    double magnetometer_sigma;   /* [T]; 0: the suite's */
    int course;                  /* 1: the vehicle flies nose first, along gnss_velocity */
    double tilt_sigma;           /* of roll and pitch [rad]; 0: the suite's */
    double rest_sigma;           /* of each axis of an unmeasured velocity [m/s]; 0: the suite's */
} qg_start;

int qg_init(qg_filter *filter, const qg_start *start);

@END@
/* A level vehicle at rest at a known place: position in I [m], heading of body x, from east toward
 * north [rad]; with the errors of the suite's initial pose. */
int qg_init_at_rest(qg_filter *filter, const double position[3], double heading, double time);

@IF BAROMETER@
/* After a start: heights of the barometer are relative to the height at the first one. */
void qg_barometer_from_start(qg_filter *filter);

@END@
/* ---- inputs ---- */

/* Propagate the estimate over dt, from 1e-9 s to QG_LONGEST_STEP: angular rate [rad/s] and specific
 * force [m/s^2] in the axes of the IMU, from which @MOUNTING@. */
int qg_predict(qg_filter *filter, const qg_real gyro[3], const qg_real accel[3], double dt);

/* Measurements of one instant, for one joint update. NULL: not measured. Standard deviations are
 * per axis; 0 or NULL: the suite's. */
typedef struct {
@FIELDS_OF_MEASUREMENTS@} qg_measurements;

/* Update the estimate. A time stamp may be late, back to qg_oldest_time: everything since then is
 * filtered again, with bitwise the result of timely arrival. It may also be later than the filter:
 * the measurement then waits for the prediction. */
int qg_update(qg_filter *filter, const qg_measurements *measured, double time);

/* The same for one measurement alone. */
@API@
/* ---- outputs ---- */

typedef struct {
    double time;           /* up to which the filter has predicted [s] */
    double position[3];    /* of the center of mass, in I [m] */
    qg_real velocity[3];   /* in I [m/s] */
    qg_real R_BI[9];       /* attitude, row by row: v_B = R_BI v_I */
    qg_real quaternion[4]; /* (w, x, y, z), body to inertial */
    qg_real accel_bias[3]; /* in B [m/s^2] */
    qg_real gyro_bias[3];  /* in B [rad/s] */
    qg_real sigma[15];     /* standard deviations: position, velocity, error angles, biases */
    int diverged;          /* 1 while innovations show that the estimate is wrong */
} qg_estimate;

int qg_state(const qg_filter *filter, qg_estimate *estimate);

/* Covariance (15, 15), row by row, in the order of qg_estimate.sigma. */
int qg_covariance(const qg_filter *filter, double covariance[225]);

enum { QG_PREDICTION_FAILED = 1, QG_UPDATE_FAILED = 2 };

/* Numerical failures since the start, as flags; after a failure the filter keeps its last good
 * state. 0: none. */
unsigned qg_status(const qg_filter *filter);

double qg_time(const qg_filter *filter);        /* up to which it has predicted [s] */
double qg_oldest_time(const qg_filter *filter); /* oldest time stamp that qg_update accepts [s] */
@IF POLICY@

/* ---- policy: @ABOUT@ ---- */

typedef struct {
    double position[3], velocity[3], acceleration[3]; /* of the reference, in I */
    double heading[3];    /* level unit vector in I along which body x is to point */
    double preview[2][3]; /* positions 0.2 s and 0.4 s later, in I; on a course: the next gates */
} qg_reference;

/* Action of the policy for the present estimate, @RATE@ times per second. Observation:
@LINES@
 *
 * Action, each component a in [-1, 1]:
@ACTIONS@ */
int qg_action(qg_filter *filter, const qg_reference *reference, float action[4]);

/* The network alone: 0, or 1 with an action of zeros if the observation is not finite. */
int qg_policy(const float observation[@SIZE@], float action[4]);
@END@

/* ---- memory: use the functions above ---- */

@STRUCTS@
struct qg_filter {
    double flight[@FLIGHT_WORDS@], params[@PARAMS_WORDS@], work[@WORK_WORDS@], steps[@STEPS_WORDS@];
    uint64_t table[@STAGES@];
    float last_action[4];
    int started;
    qg_window_record window;
    qg_event_record event[QG_EVENTS];
    qg_pending_record waits[QG_WAITING];
    qg_operation_record operation[QG_EVENTS + QG_COPIES + 4 * QG_WAITING + 8];
    qg_sample_record sample[QG_EVENTS + 2 * QG_WAITING + 4];
    qg_measurement_record measurement[QG_MEASUREMENTS + QG_WAITING];
    qg_real copy[QG_COPIES][@COPY_WORDS@];
};

#ifdef __cplusplus
}
#endif
#endif

#if defined(QUAD_GYM_FILTER_IMPLEMENTATION) && !defined(QUAD_GYM_FILTER_IMPLEMENTED)
#define QUAD_GYM_FILTER_IMPLEMENTED
@IF POLICY@
@NETWORK@
@END@
@IMPLEMENTATION@
#endif
