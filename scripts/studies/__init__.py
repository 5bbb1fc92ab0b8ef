"""Studies of the three tasks on which estimates matter: arms, trainings, reports, films."""

import os

# Policies are small, so a second thread of BLAS, which waits busily, costs more than it saves;
# several processes share the cores. NumPy reads the variable when it is imported, after this line.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
