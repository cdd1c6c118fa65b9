// The command line: simulator.exe [--server HOST:PORT] [--bind HOST:PORT] [--timeout SECONDS]
// [--insecure]. Exit status: 0 the agent closed or Ctrl-C, 1 refused, timed out or failed, 2 usage.

#if !UNITY_5_3_OR_NEWER
using System;
using System.Globalization;
using System.Net;
using System.Net.Sockets;

namespace Rotorgram
{
    static class Program
    {
        static int Main(string[] args)
        {
            if (args.Length > 0 && args[0] == "--self-test") return SelfTest.Run(args);
            IPEndPoint server = new IPEndPoint(IPAddress.Loopback, 8001);
            IPEndPoint bind = new IPEndPoint(IPAddress.Loopback, 8000);
            double timeout = 60;
            bool insecure = false;
            try
            {
                for (int i = 0; i < args.Length; i++)
                {
                    if (args[i] == "--insecure") insecure = true;
                    else if (i + 1 == args.Length) throw new FormatException(args[i] + ": unknown, or no value");
                    else if (args[i] == "--server") server = Address(args[++i]);
                    else if (args[i] == "--bind") bind = Address(args[++i]);
                    else if (args[i] == "--timeout") timeout = double.Parse(args[++i], CultureInfo.InvariantCulture);
                    else throw new FormatException(args[i] + ": expected --server, --bind, --timeout or --insecure");
                }
                using (var link = new RotorgramLink(new PointMassDrone(), server, bind, timeout, insecure))
                    return Run(link);
            }
            catch (Exception error) when (error is FormatException || error is ArgumentException)
            {
                Console.Error.WriteLine(error.Message);
                return 2;
            }
            catch (SocketException error)
            {
                Console.Error.WriteLine(bind + ": " + error.Message);
                return 1;
            }
        }

        static int Run(RotorgramLink link)
        {
            bool interrupted = false;
            Console.CancelKeyPress += (sender, e) => { e.Cancel = true; interrupted = true; };
            while (link.State != LinkState.Closed)
            {
                if (interrupted) link.Close("Ctrl-C");
                if (!link.Tick()) link.Wait();
            }
            Console.WriteLine(link.Ending);
            Console.WriteLine(
                "{0} states, {1} sessions; {2} received, {3} sent, {4} of them again; "
                + "dropped: {5} malformed, {6} foreign, {7} stale",
                link.Steps, link.Sessions, link.Received, link.Sent, link.Resent,
                link.Malformed, link.Foreign, link.Stale);
            return link.Failed ? 1 : 0;
        }

        static IPEndPoint Address(string text)
        {
            int colon = text.LastIndexOf(':');
            IPAddress host;
            ushort port;
            if (colon < 0 || !IPAddress.TryParse(text.Substring(0, colon), out host)
                || !ushort.TryParse(text.Substring(colon + 1), out port))
                throw new FormatException(text + ": expected HOST:PORT, the host as numbers");
            return new IPEndPoint(host, port);
        }
    }

    /// <summary>Golden datagrams: prints Hello, a State and Close of the env `one` of docs/golden.json,
    /// whose spec is given, as they are written here. Then what is read from each one:BYTES or
    /// two:BYTES in hexadecimal.</summary>
    static class SelfTest
    {
        public static int Run(string[] args)
        {
            const ulong session = 0x0123456789abcdef, nonce = 0xfedcba9876543210;
            var one = new RotorgramSpec { Json = args[1], Observations = 3, Choices = 3, Telemetry = 4 };
            var two = new RotorgramSpec { Drones = 2, Observations = 1 };
            var datagram = new Datagram();
            datagram.WriteHello(session, one);
            Print("hello", datagram);

            var state = new RotorgramState(one);
            state.Observations[0] = 0.25f;
            state.Observations[1] = -0f;
            state.Observations[2] = 1.5f;
            new[] { -2, -1, 5, 0.25 }.CopyTo(state.Telemetry, 0);
            datagram.WriteState(session, 1, 0, nonce, state);
            Print("state 1 echoes the nonce", datagram);
            state.Rewards[0] = 0.5;
            state.Truncated[0] = true;
            datagram.WriteState(session, 2, 0.02, 0, state);
            Print("state, truncated", datagram);

            datagram.WriteClose(session, 1, "done");
            Print("close", datagram);

            for (int i = 2; i < args.Length; i++)
                Console.WriteLine(Read(Bytes(args[i].Substring(4)), args[i].StartsWith("one:") ? one : two));
            return 0;
        }

        static string Read(byte[] bytes, RotorgramSpec spec)
        {
            var datagram = new Datagram { Length = bytes.Length };
            Array.Copy(bytes, datagram.Bytes, bytes.Length);
            if (!datagram.HeaderIsRight()) return "malformed";
            string header = datagram.Type + " " + datagram.Session.ToString("x16") + " " + datagram.Sequence;
            switch (datagram.Type)
            {
                case MessageType.Welcome:
                    ulong nonce, seed;
                    bool hasSeed;
                    bool right = datagram.ReadWelcome(out nonce, out hasSeed, out seed);
                    return right ? header + " " + nonce.ToString("x16") + " " + hasSeed + " " + seed : "malformed";
                case MessageType.Command:
                    var c = new RotorgramCommand(spec);
                    if (!datagram.ReadCommand(spec, c)) return "malformed";
                    foreach (float f in c.Actions) header += " " + f.ToString("r", CultureInfo.InvariantCulture);
                    foreach (Order order in c.Orders) header += " " + order;
                    foreach (ulong u in c.Seeds) header += " " + u;
                    return header;
                case MessageType.Refuse:
                case MessageType.Close:
                    string reason = datagram.ReadReason();
                    return reason == null ? "malformed" : header + " " + reason;
                case MessageType.Wait:
                case MessageType.Unknown:
                    return datagram.IsHeaderAlone() ? header : "malformed";
                default:
                    return "malformed";
            }
        }

        static void Print(string name, Datagram datagram)
        {
            Console.WriteLine(name + " " + BitConverter.ToString(datagram.Bytes, 0, datagram.Length)
                .Replace("-", "").ToLowerInvariant());
        }

        static byte[] Bytes(string hexadecimal)
        {
            var bytes = new byte[hexadecimal.Length / 2];
            for (int i = 0; i < bytes.Length; i++)
                bytes[i] = Convert.ToByte(hexadecimal.Substring(2 * i, 2), 16);
            return bytes;
        }
    }
}
#endif
