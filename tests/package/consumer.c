/* SPDX-License-Identifier: Apache-2.0 */
#include <track/track.h>

#include <stdio.h>

int main(void) {
    TrkVolume* volume = NULL;
    if (trkOpenVolume("/no/such/file.vdb", NULL, NULL, &volume) != TRK_ERROR_IO) {
        return 1;
    }
    printf("libtrack %s says: %s\n", trkGetVersion(), trkGetLastErrorMessage());
    return 0;
}
