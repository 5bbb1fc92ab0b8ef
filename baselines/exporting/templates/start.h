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
    const double *magnetometer;  /* magnetic field in B [T] */
    double magnetometer_sigma;   /* [T]; 0: the suite's */
    int course;                  /* 1: the vehicle flies nose first, along gnss_velocity */
    double tilt_sigma;           /* of roll and pitch [rad]; 0: the suite's */
    double rest_sigma;           /* of each axis of an unmeasured velocity [m/s]; 0: the suite's */
} qg_start;

int qg_init(qg_filter *filter, const qg_start *start);

