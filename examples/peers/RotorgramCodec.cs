// The binary codec of rotorgram's protocol (docs/protocol.md): bytes, no socket and no clock.

using System;
using System.Runtime.InteropServices;
using System.Text;

namespace Rotorgram
{
    public enum MessageType : byte
    {
        Hello = 1, Welcome, Refuse, State, Command, Close, Wait, Unknown, Alive, Missing
    }

    /// <summary>The drones of a simulator. Observation and action are one array of float32 each, or
    /// the action is one of Choices.</summary>
    public sealed class RotorgramSpec
    {
        public string Json = ""; // the EnvSpec, as Hello carries it
        public int Drones = 1;
        public int Observations; // numbers of one drone
        public int Actions = 1; // numbers of one drone
        public int Choices; // 0: actions are numbers
        public int Telemetry; // numbers of one drone, of all arrays together
        public double Period; // s
    }

    /// <summary>What the drones tell after a step or a reset. Observations are drone by drone.
    /// Telemetry is array by array, and in each drone by drone.</summary>
    public sealed class RotorgramState
    {
        public readonly double[] Rewards, Telemetry;
        public readonly float[] Observations;
        public readonly bool[] Terminated, Truncated;

        public RotorgramState(RotorgramSpec spec)
        {
            Rewards = new double[spec.Drones];
            Telemetry = new double[spec.Drones * spec.Telemetry];
            Observations = new float[spec.Drones * spec.Observations];
            Terminated = new bool[spec.Drones];
            Truncated = new bool[spec.Drones];
        }
    }

    public enum Order : byte
    {
        Fly, Reset, Freeze
    }

    /// <summary>What the drones shall do: each flies, is reset, or stays as it is.</summary>
    public sealed class RotorgramCommand
    {
        public readonly float[] Actions; // a choice as its number
        public readonly Order[] Orders;
        public readonly ulong[] Seeds; // of those that are reset, if HasSeeds
        public bool HasSeeds;

        public RotorgramCommand(RotorgramSpec spec)
        {
            Actions = new float[spec.Drones * spec.Actions];
            Orders = new Order[spec.Drones];
            Seeds = new ulong[spec.Drones];
        }
    }

    /// <summary>One datagram, in a buffer that is used again and again: nothing is allocated but
    /// the strings of Hello, Refuse and Close.</summary>
    public sealed class Datagram
    {
        public const int HeaderSize = 24, LongestText = 512, LongestDatagram = 65483, Version = 3;

        public readonly byte[] Bytes = new byte[65536];
        public int Length;

        static readonly UTF8Encoding Utf8 = new UTF8Encoding(false, true);
        static readonly uint[] CrcTable = MakeCrcTable();
        int at;

        [StructLayout(LayoutKind.Explicit)]
        struct FloatBits // the bits of a float, without the array of BitConverter.GetBytes
        {
            [FieldOffset(0)] public float Value;
            [FieldOffset(0)] public uint Bits;
        }

        // Writing.

        public void WriteHello(ulong session, RotorgramSpec spec)
        {
            Begin(MessageType.Hello, session, 0);
            Put(Version, 1); // lowest and highest version
            Put(Version, 1);
            Put(0, 2);
            Put((ulong)spec.Drones, 4);
            Put((ulong)Utf8.GetByteCount(spec.Json), 4);
            Put(0, 4);
            at += Utf8.GetBytes(spec.Json, 0, spec.Json.Length, Bytes, at);
            End();
        }

        /// <param name="time">Simulated since the session began, s.</param>
        /// <param name="nonce">That of the Welcome in State 1, 0 in all others.</param>
        public void WriteState(ulong session, ulong sequence, double time, ulong nonce, RotorgramState s)
        {
            Begin(MessageType.State, session, sequence);
            Put(time);
            Put(nonce, 8);
            foreach (float f in s.Observations) Put(f);
            Align();
            foreach (double d in s.Rewards) Put(d);
            foreach (bool b in s.Terminated) Put(b ? 1u : 0u, 1);
            foreach (bool b in s.Truncated) Put(b ? 1u : 0u, 1);
            if (s.Telemetry.Length > 0) Align();
            foreach (double d in s.Telemetry) Put(d);
            End();
        }

        /// <summary>A reason that does not fit is cut, and its control characters go.</summary>
        public void WriteClose(ulong session, ulong sequence, string reason)
        {
            var kept = new StringBuilder();
            foreach (char c in reason) kept.Append(char.IsControl(c) || char.IsSurrogate(c) ? ' ' : c);
            while (Utf8.GetByteCount(kept.ToString()) > LongestText) kept.Length--;
            Begin(MessageType.Close, session, sequence);
            Put(kept.ToString());
            End();
        }

        void Begin(MessageType type, ulong session, ulong sequence)
        {
            at = 0;
            Put(0xa7, 1);
            Put(0x52, 1);
            Put(Version, 1);
            Put((ulong)type, 1);
            Put(0, 4);
            Put(session, 8);
            Put(sequence, 8);
        }

        void End()
        {
            Length = at;
            if (Length > LongestDatagram) throw new InvalidOperationException(
                "a datagram of " + Length + " bytes is too long: fly fewer drones");
            at = 4;
            Put(Crc(), 4);
        }

        /// <summary>Every array begins at a multiple of 8 bytes.</summary>
        void Align()
        {
            while (at % 8 != 0) Bytes[at++] = 0;
        }

        void Put(ulong value, int size)
        {
            for (int i = 0; i < size; i++) Bytes[at++] = (byte)(value >> (8 * i));
        }

        void Put(double value) { Put((ulong)BitConverter.DoubleToInt64Bits(value), 8); }

        void Put(float value) { Put(new FloatBits { Value = value }.Bits, 4); }

        void Put(string text)
        {
            int size = Utf8.GetBytes(text, 0, text.Length, Bytes, at + 2);
            if (size > LongestText) throw new ArgumentException(
                "a text of " + size + " bytes: at most " + LongestText + " are allowed");
            Put((ulong)size, 2);
            at += size;
        }

        // Reading. Header first: nothing else of a datagram is looked at if that is wrong.

        public MessageType Type { get { return (MessageType)Bytes[3]; } }
        public ulong Session { get { at = 8; return Take(8); } }
        public ulong Sequence { get { at = 16; return Take(8); } }

        /// <summary>Whether magic, version and CRC are right. Refuse is the same in all versions.</summary>
        public bool HeaderIsRight()
        {
            if (Length < HeaderSize || Length > LongestDatagram) return false;
            if (Bytes[0] != 0xa7 || Bytes[1] != 0x52) return false;
            if (Bytes[2] != Version && Type != MessageType.Refuse) return false;
            at = 4;
            return Take(4) == Crc();
        }

        public bool IsHeaderAlone() { return Length == HeaderSize; }

        /// <summary>False if it is malformed, or asks for an extension or a version that is not here.</summary>
        public bool ReadWelcome(out ulong nonce, out bool hasSeed, out ulong seed)
        {
            nonce = seed = 0;
            hasSeed = false;
            if (Length < 48 || Sequence != 0 || Bytes[40] > 1 || Bytes[41] != Version) return false;
            at = HeaderSize;
            nonce = Take(8);
            seed = Take(8);
            hasSeed = Bytes[40] == 1;
            for (at = 48; at < Length;)
            {
                if (Length < at + 4) return false;
                bool critical = Take(2) >> 15 == 1;
                int size = (int)Take(2);
                if (critical || size > LongestText || Length < at + size) return false;
                at += size;
            }
            return true;
        }

        /// <summary>False if it is malformed, or of other sizes.</summary>
        public bool ReadCommand(RotorgramSpec spec, RotorgramCommand c)
        {
            int drones = spec.Drones, actions = c.Actions.Length;
            int orders = Aligned(32 + (spec.Choices > 0 ? 8 : 4) * actions);
            int seeds = Aligned(orders + drones);
            if (Length < 32) return false;
            at = HeaderSize;
            ulong count = Take(4);
            c.HasSeeds = count > 0;
            if (c.HasSeeds && count != (ulong)drones) return false;
            if (Take(4) != 0) return false; // requests: this simulator offers no events
            if (Length != (c.HasSeeds ? seeds + 8 * drones : orders + drones)) return false;
            at = 32;
            for (int i = 0; i < actions; i++)
            {
                if (spec.Choices > 0)
                {
                    ulong choice = Take(8);
                    if (choice >= (ulong)spec.Choices) return false;
                    c.Actions[i] = choice;
                    continue;
                }
                float a = c.Actions[i] = new FloatBits { Bits = (uint)Take(4) }.Value;
                if (float.IsNaN(a) || float.IsInfinity(a)) return false;
            }
            for (int i = 0; i < drones; i++)
            {
                if (Bytes[orders + i] > 2) return false;
                c.Orders[i] = (Order)Bytes[orders + i];
            }
            at = seeds;
            for (int i = 0; i < drones; i++) c.Seeds[i] = c.HasSeeds ? Take(8) : 0;
            return true;
        }

        static int Aligned(int at) { return (at + 7) / 8 * 8; }

        /// <summary>The reason of a Refuse or Close, or null if it is malformed.</summary>
        public string ReadReason()
        {
            if (Length < HeaderSize + 2) return null;
            at = HeaderSize;
            int size = (int)Take(2);
            if (size > LongestText || Length != at + size) return null;
            try
            {
                string reason = Utf8.GetString(Bytes, at, size);
                foreach (char c in reason) if (char.IsControl(c)) return null;
                return reason;
            }
            catch (ArgumentException)
            {
                return null;
            }
        }

        ulong Take(int size)
        {
            ulong value = 0;
            for (int i = 0; i < size; i++) value |= (ulong)Bytes[at++] << (8 * i);
            return value;
        }

        // CRC-32 of zlib and PNG, of everything but its own four bytes.

        uint Crc()
        {
            uint crc = 0xffffffff;
            for (int i = 0; i < Length; i++)
                if (i < 4 || i >= 8) crc = CrcTable[(crc ^ Bytes[i]) & 0xff] ^ (crc >> 8);
            return ~crc;
        }

        static uint[] MakeCrcTable()
        {
            var table = new uint[256];
            for (uint i = 0; i < 256; i++)
            {
                uint c = i;
                for (int bit = 0; bit < 8; bit++) c = (c & 1) != 0 ? 0xedb88320 ^ (c >> 1) : c >> 1;
                table[i] = c;
            }
            return table;
        }
    }
}
