/* Of the firmware: distance of a motor from the middle, m. */
#define ARM_LENGTH 0.046f
