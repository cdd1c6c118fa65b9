// The simulator's side of rotorgram's protocol (docs/protocol.md), binary codec, without Unity and
// without a drone: a script makes a RotorgramLink with its env and calls Tick() in FixedUpdate.
//
// Tick() never blocks and there is no thread. Nothing is allocated per step: the UdpClient is
// connected, so its socket reads into a buffer of ours (UdpClient.Receive would return a new array
// for each datagram, and the unconnected ReceiveFrom makes an IPEndPoint).

using System;
using System.Diagnostics;
using System.Net;
using System.Net.Sockets;
using System.Security.Cryptography;

namespace Rotorgram
{
    /// <summary>The drones that are flown. Both calls come from Tick, and return when all is done.</summary>
    public interface IRotorgramEnv
    {
        RotorgramSpec Spec { get; }

        /// <summary>Follow the order of each drone: reset it (with its seed, if there are seeds), fly
        /// it for one control period with its action, or leave it as it is. Then write what it
        /// tells. A drone that was not flown tells reward 0 and neither flag.</summary>
        void Advance(RotorgramCommand command, RotorgramState state);
    }

    public enum LinkState
    {
        Hello, Waiting, Closing, Closed
    }

    public sealed class RotorgramLink : IDisposable
    {
        const double FirstResend = 0.2, LeastResend = 0.005, MostResend = 1.0;
        const double CloseResend = 0.025, CloseFor = 0.25;
        const int MostPerTick = 100; // datagrams: a flood must not hold up the frame

        readonly IRotorgramEnv env;
        readonly RotorgramSpec spec;
        readonly RotorgramState state;
        readonly RotorgramCommand command;
        readonly UdpClient udp;
        readonly double timeout;
        readonly Datagram output = new Datagram(), input = new Datagram();
        readonly RandomNumberGenerator random = RandomNumberGenerator.Create();

        ulong session, sequence, nonce;
        double time; // simulated in this session, s
        bool resentOnce;
        double sentAt, dueAt, wait, giveUpAt;
        double roundTrip = -1, variation;

        public LinkState State { get; private set; }
        public string Ending { get; private set; } // why the link is closing or closed
        public bool Failed { get; private set; } // refused, timed out, or an error of the agent
        public long Steps { get; private set; }
        public long Sent { get; private set; }
        public long Received { get; private set; }
        public long Resent { get; private set; }
        public long Sessions { get; private set; }
        public long Malformed { get; private set; }
        public long Foreign { get; private set; }
        public long Stale { get; private set; }
        public long Unsent { get; private set; }

        public RotorgramLink(
            IRotorgramEnv env, IPEndPoint server, IPEndPoint bind, double timeout = 60, bool insecure = false)
        {
            if (!insecure && !(IPAddress.IsLoopback(server.Address) && IPAddress.IsLoopback(bind.Address)))
                throw new ArgumentException("server, bind: expected loopback addresses, or insecure");
            this.env = env;
            this.timeout = timeout;
            spec = env.Spec;
            state = new RotorgramState(spec);
            command = new RotorgramCommand(spec);
            udp = new UdpClient(bind);
            udp.Connect(server); // from now on the system drops what others send
            udp.Client.Blocking = false;
            BeginSession();
        }

        /// <summary>Read what is there, step the env if a Command has come, send what is due.
        /// True if the env was stepped (at most once): then a frame may be drawn.</summary>
        public bool Tick()
        {
            for (int i = 0; i < MostPerTick && State != LinkState.Closed && Receive(); i++)
            {
                Received++;
                if (Handle()) return true;
            }
            double now = Now();
            if (State == LinkState.Closed) return false;
            if (now >= giveUpAt) GiveUp();
            else if (now >= dueAt) Resend(now);
            return false;
        }

        /// <summary>For programs without frames: sleep until a datagram comes or something is due.</summary>
        public void Wait()
        {
            double left = Math.Min(dueAt, giveUpAt) - Now();
            if (State != LinkState.Closed && left > 0)
                udp.Client.Poll((int)(1e6 * Math.Min(left, 1)), SelectMode.SelectRead);
        }

        /// <summary>End the run. Tick goes on until State is Closed, 0.25 s at most.</summary>
        public void Close(string reason)
        {
            if (State >= LinkState.Closing) return;
            Ending = reason;
            if (State == LinkState.Hello)
            {
                State = LinkState.Closed;
                return;
            }
            State = LinkState.Closing;
            output.WriteClose(session, sequence, reason);
            Send();
            double now = Now();
            dueAt = now + CloseResend;
            giveUpAt = now + CloseFor;
        }

        public void Dispose()
        {
            Close("the simulator has ended");
            for (; State != LinkState.Closed; Wait()) Tick(); // until it is answered, 0.25 s at most
            udp.Close();
            random.Dispose();
        }

        // What comes.

        /// <summary>Handle the datagram in `input`. True if the env was stepped.</summary>
        bool Handle()
        {
            if (!input.HeaderIsRight()) { Malformed++; return false; }
            if (input.Session != session) { Foreign++; return false; }
            switch (input.Type)
            {
                case MessageType.Welcome: return Welcomed();
                case MessageType.Refuse: Refused(); return false;
                case MessageType.Wait: ToldToWait(); return false;
                case MessageType.Alive: StillThere(); return false;
                case MessageType.Command: return Commanded();
                case MessageType.Unknown: NotKnown(); return false;
                case MessageType.Close: Closed(); return false;
                default: Malformed++; return false;
            }
        }

        bool Welcomed()
        {
            ulong number, seed;
            bool hasSeed;
            if (!input.ReadWelcome(out number, out hasSeed, out seed)) { Malformed++; return false; }
            if (State != LinkState.Hello) { Stale++; return false; }
            nonce = number; // State 1 echoes it; with a key it would enter that of the session
            Measure();
            for (int i = 0; i < spec.Drones; i++)
            {
                command.Orders[i] = Order.Reset;
                command.Seeds[i] = unchecked((hasSeed ? seed : session) + (ulong)i);
            }
            command.HasSeeds = true;
            return Advance();
        }

        bool Commanded()
        {
            if (!input.ReadCommand(spec, command)) { Malformed++; return false; }
            if (State != LinkState.Waiting || input.Sequence != sequence) { Stale++; return false; }
            Measure();
            for (int i = 0; i < spec.Drones; i++)
            {
                if (command.Orders[i] != Order.Fly || !(state.Terminated[i] || state.Truncated[i])) continue;
                Failed = true;
                Close("drone " + i + " was flown on after its episode's end: send a reset");
                return false;
            }
            return Advance();
        }

        void Refused()
        {
            string reason = input.ReadReason();
            if (reason == null || input.Sequence != 0) { Malformed++; return; }
            if (State != LinkState.Hello) { Stale++; return; }
            Failed = true;
            Close("refused by the agent: " + reason);
        }

        void ToldToWait()
        {
            if (!input.IsHeaderAlone() || input.Sequence != 0) { Malformed++; return; }
            if (State != LinkState.Hello) { Stale++; return; }
            giveUpAt = Now() + timeout; // the Hello goes on by its timer
        }

        /// <summary>The agent waits for other simulators.</summary>
        void StillThere()
        {
            if (!input.IsHeaderAlone()) { Malformed++; return; }
            if (State != LinkState.Waiting || input.Sequence != sequence) { Stale++; return; }
            giveUpAt = Now() + timeout; // the State goes on by its timer
        }

        void NotKnown()
        {
            if (!input.IsHeaderAlone()) { Malformed++; return; }
            if (State != LinkState.Waiting || input.Sequence != sequence) { Stale++; return; }
            BeginSession();
        }

        void Closed()
        {
            string reason = input.ReadReason();
            if (reason == null) { Malformed++; return; }
            if (State == LinkState.Closing) { State = LinkState.Closed; return; }
            bool fits = input.Sequence == sequence || input.Sequence == sequence - 1;
            if (State != LinkState.Waiting || !fits) { Stale++; return; }
            output.WriteClose(session, sequence, "");
            Send();
            Ending = reason == "" ? "the agent closed" : reason;
            State = LinkState.Closed;
        }

        // What goes out.

        void BeginSession()
        {
            var bytes = new byte[8];
            do
            {
                random.GetBytes(bytes);
                session = BitConverter.ToUInt64(bytes, 0);
            } while (session == 0);
            sequence = 0;
            time = -spec.Period; // State 1 is at 0
            Sessions++;
            State = LinkState.Hello;
            output.WriteHello(session, spec);
            FirstSend();
        }

        bool Advance()
        {
            try
            {
                env.Advance(command, state);
                Check(state.Rewards);
                Check(state.Telemetry);
                foreach (float f in state.Observations) Check(f);
                time += spec.Period;
                output.WriteState(session, sequence + 1, time, sequence == 0 ? nonce : 0, state);
            }
            catch (Exception error)
            {
                Failed = true;
                Close("error of the simulator: " + error.Message);
                throw;
            }
            sequence++;
            Steps++;
            State = LinkState.Waiting;
            FirstSend();
            return true;
        }

        static void Check(double[] numbers)
        {
            foreach (double d in numbers) Check(d);
        }

        static void Check(double d)
        {
            if (double.IsNaN(d) || double.IsInfinity(d))
                throw new InvalidOperationException("the env told a number that is not finite");
        }

        void FirstSend()
        {
            wait = roundTrip < 0
                ? FirstResend
                : Math.Max(LeastResend, Math.Min(MostResend, roundTrip + 4 * variation));
            resentOnce = false;
            Send();
            sentAt = Now();
            dueAt = sentAt + wait;
            giveUpAt = sentAt + timeout;
        }

        void Resend(double now)
        {
            Send(); // identical bytes
            Resent++;
            resentOnce = true;
            wait = State == LinkState.Closing ? CloseResend : Math.Min(2 * wait, MostResend);
            dueAt = now + wait;
        }

        void GiveUp()
        {
            if (State == LinkState.Closing)
            {
                State = LinkState.Closed;
                return;
            }
            Failed = true;
            Close("no answer from the agent for " + timeout + " s");
        }

        /// <summary>The round trip that has ended now, smoothed as RFC 6298 has it.</summary>
        void Measure()
        {
            if (resentOnce) return; // which of the two was answered cannot be told
            double trip = Now() - sentAt;
            variation = roundTrip < 0 ? trip / 2 : 0.75 * variation + 0.25 * Math.Abs(roundTrip - trip);
            roundTrip = roundTrip < 0 ? trip : 0.875 * roundTrip + 0.125 * trip;
        }

        // The socket. Its errors (nobody listens there yet) count as losses: no exceptions.

        bool Receive()
        {
            for (int tries = 0; tries < 3; tries++)
            {
                SocketError error;
                input.Length = udp.Client.Receive(
                    input.Bytes, 0, input.Bytes.Length, SocketFlags.None, out error);
                if (error == SocketError.Success) return true;
                if (error == SocketError.WouldBlock) return false;
            }
            return false;
        }

        void Send()
        {
            SocketError error;
            udp.Client.Send(output.Bytes, 0, output.Length, SocketFlags.None, out error);
            if (error != SocketError.Success) // it may be that of an earlier datagram: once more
                udp.Client.Send(output.Bytes, 0, output.Length, SocketFlags.None, out error);
            if (error == SocketError.Success) Sent++;
            else Unsent++;
        }

        static double Now() { return Stopwatch.GetTimestamp() / (double)Stopwatch.Frequency; }
    }
}
