@CALL@
{
    qg_measurements m = {0};
    m.@NAME@ = @ADDRESS@;
@SIGMA@    return qg_update(f, &m, time);
}

