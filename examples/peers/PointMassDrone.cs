// The task of docs/task.md with its default options, flown by a point mass: rotorgram/Elevation-v0.

using System;

namespace Rotorgram
{
    /// <summary>A craft of 20 kg on four rotors that moves in the vertical alone. Where an engine shall
    /// move it, a subclass overrides Place and Move.</summary>
    public class PointMassDrone : IRotorgramEnv
    {
        protected const double Mass = 20, Gravity = 9.8, PhysicsStep = 0.01;
        protected const int Substeps = 2; // in a control period
        const double MostThrust = 100, HoverThrust = Mass * Gravity / 4, ThrustPerAction = 5;
        const double Target = 5, StartBand = 1, FlightBand = 3, RewardScale = 0.5, Crash = 20;
        const int EpisodeLength = 250;

        // What docs/protocol.md calls the EnvSpec. Every option of the task is in it.
        const string Json = @"{
            'env_id': 'rotorgram/Elevation-v0',
            'options': {
                'episode_length': 250, 'history': 1, 'control_period': 0.02, 'target': 5.0,
                'start_band': 1.0, 'flight_band': 3.0, 'action': 'increment',
                'action_type': 'continuous', 'observation': 'full', 'thrust_scale': null},
            'control_period': 0.02,
            'vehicle': 'point mass',
            'observation': [{
                'name': 'observation', 'shape': [3], 'unit': ['m', 'm/s', '1'], 'frame': 'world, up',
                'low': [-3.225358724594116, -11.267924308776855, -1.0000001192092896],
                'high': [3.225358724594116, 11.267924308776855, 1.0408164262771606],
                'components': ['elevation error', 'rate of the error', 'thrust over hover']}],
            'action': {
                'name': 'action', 'shape': [1], 'low': -1, 'high': 1, 'components': ['collective']},
            'telemetry': [
                {'name': 'position', 'shape': [3], 'dtype': 'float64', 'unit': 'm',
                 'frame': 'world', 'components': ['x', 'y', 'z']},
                {'name': 'attitude', 'shape': [4], 'dtype': 'float64', 'frame': 'body to world',
                 'components': ['qw', 'qx', 'qy', 'qz']},
                {'name': 'velocity', 'shape': [3], 'dtype': 'float64', 'unit': 'm/s',
                 'frame': 'world', 'components': ['vx', 'vy', 'vz']},
                {'name': 'body_rates', 'shape': [3], 'dtype': 'float64', 'unit': 'rad/s',
                 'frame': 'body', 'components': ['rate_x', 'rate_y', 'rate_z']},
                {'name': 'thrust', 'shape': [4], 'dtype': 'float64', 'low': 0, 'high': 100,
                 'unit': 'N', 'components': ['F1', 'F2', 'F3', 'F4']},
                {'name': 'goal', 'shape': [3], 'dtype': 'float64', 'unit': 'm', 'frame': 'world',
                 'components': ['goal_x', 'goal_y', 'goal_z']},
                {'name': 'metrics', 'shape': [1], 'dtype': 'float64', 'unit': ['m'],
                 'components': ['elevation_error']}],
            'metrics': [{
                'name': 'elevation_error', 'unit': 'm', 'goal': 'zero',
                'settled': 0.05, 'held': 0.1, 'symbol': 'E', 'signed': true}],
            'constants': {'gravity': 9.8}
        }";

        readonly RotorgramSpec spec = new RotorgramSpec
        {
            Json = Json.Replace('\'', '"'),
            Observations = 3,
            Telemetry = 21,
            Period = Substeps * PhysicsStep
        };

        protected double Height, ClimbRate; // m, m/s
        double thrust; // of each rotor, N
        int steps;
        ulong generator;

        public RotorgramSpec Spec { get { return spec; } }

        public void Advance(RotorgramCommand command, RotorgramState state)
        {
            if (command.Orders[0] != Order.Fly)
            {
                state.Terminated[0] = state.Truncated[0] = false;
                state.Rewards[0] = 0;
            }
            if (command.Orders[0] == Order.Reset)
            {
                if (command.HasSeeds) generator = command.Seeds[0];
                Place(Target + StartBand * (2 * Random() - 1));
                thrust = HoverThrust;
                steps = 0;
            }
            else if (command.Orders[0] == Order.Fly)
            {
                double action = Math.Max(-1, Math.Min(1, command.Actions[0]));
                thrust = Math.Max(0, Math.Min(MostThrust, thrust + ThrustPerAction * action));
                Move(4 * thrust);
                steps++;
                double off = Math.Abs(Target - Height);
                state.Terminated[0] = off > FlightBand || Height <= 0;
                state.Truncated[0] = steps >= EpisodeLength && !state.Terminated[0];
                state.Rewards[0] = (RewardScale - off) / (RewardScale + off)
                    - (state.Terminated[0] ? Crash : 0);
            }
            state.Observations[0] = (float)(Target - Height);
            state.Observations[1] = (float)(0 - ClimbRate);
            state.Observations[2] = (float)(thrust / HoverThrust - 1);
            state.Telemetry[2] = Height; // x and y stay 0
            state.Telemetry[3] = 1; // it is level: the quaternion is 1, 0, 0, 0
            state.Telemetry[9] = ClimbRate;
            for (int rotor = 13; rotor < 17; rotor++) state.Telemetry[rotor] = thrust;
            state.Telemetry[19] = Target;
            state.Telemetry[20] = Target - Height;
        }

        /// <summary>Put the craft there, level and at rest.</summary>
        protected virtual void Place(double height)
        {
            Height = height;
            ClimbRate = 0;
        }

        /// <summary>One control period with this force upwards, N. Exact: the force is constant.</summary>
        protected virtual void Move(double force)
        {
            double acceleration = force / Mass - Gravity;
            for (int i = 0; i < Substeps; i++)
            {
                Height += ClimbRate * PhysicsStep + acceleration * PhysicsStep * PhysicsStep / 2;
                ClimbRate += acceleration * PhysicsStep;
            }
        }

        /// <summary>0 to 1, by SplitMix64: the same on every machine for the same seed.</summary>
        double Random()
        {
            unchecked
            {
                ulong z = generator += 0x9e3779b97f4a7c15;
                z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9;
                z = (z ^ (z >> 27)) * 0x94d049bb133111eb;
                return ((z ^ (z >> 31)) >> 11) / 9007199254740992.0;
            }
        }
    }
}
