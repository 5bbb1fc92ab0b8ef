    if (!error)
        error = qgi_block(m->@NAME@, @COUNT@, &r.valid[@BLOCK@], r.aid_measurement[@INDEX@]);
    if (!error && m->@NAME@_sigma != 0.0)
        error = qgi_noise(m->@NAME@, &m->@NAME@_sigma, 1, 1e-12, &r.aid_sigma[@INDEX@]);
