// The task of docs/task.md with its default options, flown by a point mass: rotorgram/Elevation-v0.

using System;

namespace Rotorgram
{
    /// <summary>A craft of 20 kg on four rotors that moves in the vertical alone. Where an engine shall
    /// move it, a subclass overrides Place and Move.</summary>
    public class PointMassDrone : IRotorgramEnv
    {
        protected const double Mass = 20, Gravity = 9.8, PhysicsStep = 0.005;
        protected const int Substeps = 4; // in a control period
        const double MostThrust = 100, HoverThrust = Mass * Gravity / 4, ThrustPerAction = 5;
        const double Target = 5, StartBand = 1, FlightBand = 3, RewardScale = 0.5, Crash = 20;
        const int EpisodeLength = 250;

        readonly RotorgramSpec spec = new RotorgramSpec
        {
            EnvId = "rotorgram/Elevation-v0",
            Telemetry = "X,Y,Z,phi,theta,psi,F1,F2,F3,F4",
            Period = Substeps * PhysicsStep,
            // An agent refuses spaces that differ by a bit: these are those of rotorgram.envs.
            ObservationLow = new[] { -3.2253587f, -11.267924f, -1.0000001f },
            ObservationHigh = new[] { 3.2253587f, 11.267924f, 1.0408164f },
            ActionLow = new[] { -1f },
            ActionHigh = new[] { 1f }
        };

        protected double Height, ClimbRate; // m, m/s
        double thrust; // of each rotor, N
        int steps;
        ulong generator;

        public RotorgramSpec Spec { get { return spec; } }

        public void Advance(RotorgramCommand command, RotorgramState state)
        {
            if (command.Reset[0])
            {
                if (command.HasSeeds) generator = command.Seeds[0];
                Place(Target + StartBand * (2 * Random() - 1));
                thrust = HoverThrust;
                steps = 0;
                state.Terminated[0] = state.Truncated[0] = false;
                state.Rewards[0] = 0;
            }
            else
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
            state.Telemetry[1] = Height; // X, Z and the angles stay 0
            for (int rotor = 6; rotor < 10; rotor++) state.Telemetry[rotor] = thrust;
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
