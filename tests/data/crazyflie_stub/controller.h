/* What the app of `export --to crazyflie` takes of the firmware's controller.h, by the same names: enough to build it
 * on this machine. */
#ifndef STUB_CONTROLLER_H
#define STUB_CONTROLLER_H

#include <stdbool.h>
#include <stdint.h>

typedef struct { float x, y, z; } vector_t;
typedef struct { float x, y, z, w; } quaternion_t;
typedef struct { float roll, pitch, yaw; } attitude_t;
typedef struct { vector_t acc, gyro; } sensorData_t;
typedef struct {
    attitude_t attitude;
    quaternion_t attitudeQuaternion;
    vector_t position, velocity;
} state_t;

typedef enum { modeDisable = 0, modeAbs, modeVelocity } stab_mode_t;
typedef struct {
    attitude_t attitude;
    vector_t position;
    struct { stab_mode_t x, y, z, yaw; } mode;
} setpoint_t;

typedef enum { controlModeLegacy = 0, controlModeForceTorque = 1 } control_mode_t;
typedef struct {
    float thrustSi, torqueX, torqueY, torqueZ;
    control_mode_t controlMode;
} control_t;

void controllerOutOfTreeInit(void);
bool controllerOutOfTreeTest(void);
void controllerOutOfTree(control_t *control, const setpoint_t *setpoint, const sensorData_t *sensors,
                         const state_t *state, const uint32_t tick);
#endif
