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
    if (speed < @LEAST_COURSE@ * sigma)
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
