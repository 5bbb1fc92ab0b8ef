"""Studies of the three tasks on which estimates matter: arms, trainings, reports, films."""
