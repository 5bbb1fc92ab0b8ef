@CALL@
{
    qg_measurements m;
    memset(&m, 0, sizeof m);
    m.@NAME@ = @ADDRESS@;
@SIGMA@    return qg_update(f, &m, time);
}

