/* Copyright 2026 The accel_calib authors
   SPDX-License-Identifier: Apache-2.0

   Correct readings by exported headers: lines of the number of a header, x, y, z and a temperature
   become lines of forces. cases.h includes the headers, each twice, and has the calls as CASES. */

#include <stdio.h>
#include "cases.h"

int main(void)
{
    float raw[3], force[3], t;
    int which;
    while (scanf("%d %f %f %f %f", &which, raw, raw + 1, raw + 2, &t) == 5) {
        switch (which) {
        CASES
        default: return 1;
        }
        printf("%.9g %.9g %.9g\n", (double)force[0], (double)force[1], (double)force[2]);
    }
    return 0;
}
