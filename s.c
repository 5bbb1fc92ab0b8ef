int printf(const char*,...);
#include "quad_gym_filter.h"
int main(void){printf("%zu\n",sizeof(qg_filter));}
