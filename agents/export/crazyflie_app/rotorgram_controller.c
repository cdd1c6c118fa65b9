/* SPDX-License-Identifier: MIT
 *
 * A policy of rotorgram as the out-of-tree controller of the Crazyflie's firmware: from the estimate
 * and the gyroscope to the thrust of each motor. It flies to the position and heading of the setpoint;
 * an axis without a wanted position keeps the last one. Without a setpoint the motors stop.
 */
#include <math.h>
#include <stdbool.h>
#include <stdint.h>

#include "controller.h"
#include "platform_defaults.h"
#include "rotorgram_policy.h"
#include "rotorgram_crazyflie.h"

#ifndef THRUST2TORQUE /* older firmware has it as a parameter, of this default */
#define THRUST2TORQUE 0.005964552f
#endif

#define RADIANS 0.017453293f /* of a degree */
#define GRAVITY 9.81f        /* m/s^2, of the firmware's G */

/* By rotor of the vehicle's file, N. */
static const float hover[] = ROTORGRAM_HOVER;
static const float least[] = ROTORGRAM_LEAST;
static const float largest[] = ROTORGRAM_LARGEST;

/* Of the observation. */
static const float lowest[] = ROTORGRAM_LOWEST;
static const float highest[] = ROTORGRAM_HIGHEST;

#ifdef ROTORGRAM_WRENCH
#define TOLD 9
/* What is told of the craft: without thrust, and more by a newton of each rotor. */
static const float told[TOLD] = ROTORGRAM_TOLD;
static const float told_more[ROTORGRAM_ROTORS * TOLD] = ROTORGRAM_TOLD_MORE;

static const float lift[] = ROTORGRAM_LIFT;             /* of actions of 0, and 1 more, N */
static const float torque_of[] = ROTORGRAM_TORQUE;      /* of actions of 1, N m, rows of 3 */
static const float mix[] = ROTORGRAM_MIX;               /* N by N m, a row of 3 for each rotor */
static const float share[] = ROTORGRAM_SHARE;           /* of the collective thrust */
static const float collective[] = ROTORGRAM_COLLECTIVE; /* its ends, N */
static const float lead[] = ROTORGRAM_LEAD;
static float asked[ROTORGRAM_ROTORS]; /* thrusts, N */
#endif

/* What a rotor's speed still lacks of its command after a step, as a share: rising and falling. */
static const float lacking[] = ROTORGRAM_LACKING;
static const int rotor_of_motor[] = ROTORGRAM_MOTORS;

static bool flying;
static int wait;                        /* calls until the next action */
static float goal[3];                   /* world, m */
static float heading;                   /* anticlockwise from x, rad */
static float command[ROTORGRAM_ROTORS]; /* N */
static float thrust[ROTORGRAM_ROTORS];  /* N: no sensor measures it, so that the lag tells it */
#ifdef ROTORGRAM_STATE
static rotorgram_policy_state memory;
#endif

/* What an observation is made of, by the names that rotorgram_crazyflie.h uses. */
struct seen {
    float way[3];      /* to the goal, m */
    float velocity[3]; /* m/s */
    float nose[3], thrust_axis[3], up[3], wanted_nose[3];
    float rates[3];  /* body, rad/s */
    float force[3];  /* specific, body, m/s^2 */
    float over[ROTORGRAM_ROTORS]; /* thrust over that of a hover, minus 1 */
#ifdef ROTORGRAM_WRENCH
    float told[TOLD]; /* accelerations now, the largest ones and the lag, over their units */
#endif
};

static float within(float value, float low, float high)
{
    return value < low ? low : value > high ? high : value;
}

static void begin(const state_t *state)
{
    goal[0] = state->position.x;
    goal[1] = state->position.y;
    goal[2] = state->position.z;
    heading = state->attitude.yaw * RADIANS;
    for (int i = 0; i < ROTORGRAM_ROTORS; i++)
        thrust[i] = command[i] = hover[i];
#ifdef ROTORGRAM_STATE
    rotorgram_policy_init(&memory);
#endif
    wait = 0;
    flying = true;
}

static void aim(const setpoint_t *setpoint)
{
    if (setpoint->mode.x == modeAbs)
        goal[0] = setpoint->position.x;
    if (setpoint->mode.y == modeAbs)
        goal[1] = setpoint->position.y;
    if (setpoint->mode.z == modeAbs)
        goal[2] = setpoint->position.z;
    if (setpoint->mode.yaw == modeAbs)
        heading = setpoint->attitude.yaw * RADIANS;
}

/* Columns of the rotation from body to world. */
static void axes_of(const quaternion_t *q, float axes[3][3])
{
    const float x = q->x, y = q->y, z = q->z, w = q->w;
    axes[0][0] = 1.0f - 2.0f * (y * y + z * z);
    axes[0][1] = 2.0f * (x * y + w * z);
    axes[0][2] = 2.0f * (x * z - w * y);
    axes[1][0] = 2.0f * (x * y - w * z);
    axes[1][1] = 1.0f - 2.0f * (x * x + z * z);
    axes[1][2] = 2.0f * (y * z + w * x);
    axes[2][0] = 2.0f * (x * z + w * y);
    axes[2][1] = 2.0f * (y * z - w * x);
    axes[2][2] = 1.0f - 2.0f * (x * x + y * y);
}

/* A vector of the world in the frame of the observation. */
static void into_frame(float axes[3][3], const float vector[3], float out[3])
{
#if ROTORGRAM_BODY
    for (int i = 0; i < 3; i++)
        out[i] = axes[i][0] * vector[0] + axes[i][1] * vector[1] + axes[i][2] * vector[2];
#else
    const float c = cosf(heading), s = sinf(heading);
    (void)axes;
    out[0] = c * vector[0] + s * vector[1];
    out[1] = c * vector[1] - s * vector[0];
    out[2] = vector[2];
#endif
}

static struct seen look(const sensorData_t *sensors, const state_t *state)
{
    struct seen seen;
    float axes[3][3];
    const float way[] = {goal[0] - state->position.x, goal[1] - state->position.y,
                         goal[2] - state->position.z};
    const float velocity[] = {state->velocity.x, state->velocity.y, state->velocity.z};
    axes_of(&state->attitudeQuaternion, axes);
    into_frame(axes, way, seen.way);
    into_frame(axes, velocity, seen.velocity);
    into_frame(axes, axes[0], seen.nose);
    into_frame(axes, axes[2], seen.thrust_axis);
    const float c = cosf(heading), s = sinf(heading);
    for (int i = 0; i < 3; i++) {
        seen.up[i] = axes[i][2];
        seen.wanted_nose[i] = c * axes[i][0] + s * axes[i][1];
    }
    seen.rates[0] = sensors->gyro.x * RADIANS;
    seen.rates[1] = sensors->gyro.y * RADIANS;
    seen.rates[2] = sensors->gyro.z * RADIANS;
    seen.force[0] = sensors->acc.x * GRAVITY;
    seen.force[1] = sensors->acc.y * GRAVITY;
    seen.force[2] = sensors->acc.z * GRAVITY;
    for (int i = 0; i < ROTORGRAM_ROTORS; i++)
        seen.over[i] = thrust[i] / hover[i] - 1.0f;
#ifdef ROTORGRAM_WRENCH
    for (int i = 0; i < TOLD; i++) {
        seen.told[i] = told[i];
        for (int rotor = 0; rotor < ROTORGRAM_ROTORS; rotor++)
            seen.told[i] += told_more[rotor * TOLD + i] * thrust[rotor];
    }
#endif
    return seen;
}

#ifdef ROTORGRAM_WRENCH
/* Thrusts of a collective thrust and a torque. Roll and pitch come first, scaled down alike where they span
 * more than the rotors' range; the collective thrust moves as little as makes room for them; yaw gets the
 * room that is left. */
static void mixed(float thrust_sum, const float torque[3])
{
    const float low = collective[0];
    float high = collective[1];
    float part[ROTORGRAM_ROTORS], lower = 0.0f, upper = 0.0f, yaw = torque[2];
#ifdef THRUST_MAX /* what the battery compensation can hold */
    for (int i = 0; i < ROTORGRAM_ROTORS; i++)
        high = fminf(high, THRUST_MAX / share[i]);
#endif
    for (int i = 0; i < ROTORGRAM_ROTORS; i++) {
        part[i] = mix[3 * i] * torque[0] + mix[3 * i + 1] * torque[1];
        lower = i == 0 ? part[i] : fminf(lower, part[i]);
        upper = i == 0 ? part[i] : fmaxf(upper, part[i]);
    }
    const float scale = fminf((high - low) / fmaxf(upper - lower, 1e-9f * high), 1.0f);
    const float middle = fminf(fmaxf(thrust_sum, low - scale * lower), high - scale * upper);
    float first = -INFINITY, last = INFINITY; /* of yaw */
    for (int i = 0; i < ROTORGRAM_ROTORS; i++) {
        const float by = mix[3 * i + 2];
        part[i] = middle + scale * part[i];
        if (by != 0.0f) {
            first = fmaxf(first, fminf((low - part[i]) / by, (high - part[i]) / by));
            last = fminf(last, fmaxf((low - part[i]) / by, (high - part[i]) / by));
        }
    }
    yaw = fminf(fmaxf(yaw, first), last); /* where there is no room, the upper end holds */
    for (int i = 0; i < ROTORGRAM_ROTORS; i++)
        asked[i] = share[i] * (part[i] + mix[3 * i + 2] * yaw);
}
#endif

static void act(const sensorData_t *sensors, const state_t *state)
{
    const struct seen seen = look(sensors, state);
    float observation[ROTORGRAM_OBSERVATIONS] = ROTORGRAM_SOURCES;
    float action[ROTORGRAM_ACTIONS];
    for (int i = 0; i < ROTORGRAM_OBSERVATIONS; i++)
        observation[i] = within(observation[i], lowest[i], highest[i]);
#ifdef ROTORGRAM_STATE
    rotorgram_policy(&memory, observation, action);
#else
    rotorgram_policy(observation, action);
#endif
#ifdef ROTORGRAM_WRENCH
    float torque[3];
    for (int i = 0; i < 3; i++)
        torque[i] = torque_of[3 * i] * action[1] + torque_of[3 * i + 1] * action[2] +
                    torque_of[3 * i + 2] * action[3];
    mixed(lift[0] + lift[1] * action[0], torque);
#else
    for (int i = 0; i < ROTORGRAM_ROTORS; i++) {
        const float room = action[i] > 0.0f ? largest[i] - hover[i] : hover[i] - least[i];
        command[i] = hover[i] + room * action[i];
    }
#endif
}

/* Before each step of the rotors. */
static void drive(void)
{
    for (int i = 0; i < ROTORGRAM_ROTORS; i++) {
#ifdef ROTORGRAM_WRENCH
        command[i] = within(thrust[i] + lead[0] * (asked[i] - thrust[i]), least[i], largest[i]);
#endif
#ifdef THRUST_MAX /* what the battery compensation can hold */
        command[i] = within(command[i], least[i], THRUST_MAX);
#endif
    }
}

/* The speeds of the rotors, as roots of their thrusts, follow the commands for one step. */
static void turn_rotors(void)
{
    for (int i = 0; i < ROTORGRAM_ROTORS; i++) {
        const float wanted = sqrtf(command[i]), speed = sqrtf(thrust[i]);
        const float next = wanted + lacking[wanted < speed] * (speed - wanted);
        thrust[i] = next * next;
    }
}

/* Sums that the firmware's mixer takes apart again, into the same four forces. */
static void push(control_t *control)
{
    const float arm = 0.707106781f * ARM_LENGTH;
    float f[4];
    for (int i = 0; i < 4; i++)
        f[i] = flying ? command[rotor_of_motor[i]] : 0.0f;
    control->controlMode = controlModeForceTorque;
    control->thrustSi = f[0] + f[1] + f[2] + f[3];
    control->torqueX = arm * (f[2] + f[3] - f[0] - f[1]);
    control->torqueY = arm * (f[1] + f[2] - f[0] - f[3]);
    control->torqueZ = THRUST2TORQUE * (f[1] + f[3] - f[0] - f[2]);
}

void controllerOutOfTreeInit(void)
{
    flying = false;
}

bool controllerOutOfTreeTest(void)
{
    return true;
}

/* Called every millisecond. */
void controllerOutOfTree(control_t *control, const setpoint_t *setpoint, const sensorData_t *sensors,
                         const state_t *state, const uint32_t tick)
{
    (void)tick;
    if (setpoint->mode.z == modeDisable) {
        flying = false;
    } else {
        if (!flying)
            begin(state);
        else if (wait % ROTORGRAM_DRIVEN == 0)
            turn_rotors();
        aim(setpoint);
        if (wait == 0) {
            act(sensors, state);
            wait = ROTORGRAM_CALLS;
        }
        if (wait % ROTORGRAM_DRIVEN == 0)
            drive();
        wait--;
    }
    push(control);
}
