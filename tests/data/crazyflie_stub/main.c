/* Reads records of 23 floats: mode (0 off, 1 goal, 2 goal along z alone), goal x, y, z and heading (degrees), then position, velocity, quaternion
 * w x y z, gyro (degrees/s), accelerometer (g), yaw of the estimate (degrees), and how often the controller is called.
 * Writes what is asked of the firmware's mixer after the last call: total thrust and three torques. */
#include <stdio.h>
#include "controller.h"

int main(void)
{
    float in[23];
    control_t control = {0};
    controllerOutOfTreeInit();
    if (!controllerOutOfTreeTest())
        return 1;
    while (fread(in, sizeof in, 1, stdin) == 1) {
        const stab_mode_t mode = in[0] > 0.0f ? modeAbs : modeDisable;
        const stab_mode_t level = in[0] > 1.0f ? modeVelocity : mode;
        const setpoint_t setpoint = {
            .attitude = {.yaw = in[4]}, .position = {in[1], in[2], in[3]}, .mode = {level, level, mode, level}};
        const state_t state = {
            .attitude = {.yaw = in[21]}, .attitudeQuaternion = {in[12], in[13], in[14], in[11]},
            .position = {in[5], in[6], in[7]}, .velocity = {in[8], in[9], in[10]}};
        const sensorData_t sensors = {.gyro = {in[15], in[16], in[17]}, .acc = {in[18], in[19], in[20]}};
        for (int call = 0; call < (int)in[22]; call++)
            controllerOutOfTree(&control, &setpoint, &sensors, &state, (uint32_t)call);
        if (control.controlMode != controlModeForceTorque)
            return 1;
        fwrite(&control, sizeof(float), 4, stdout);
    }
    return 0;
}
