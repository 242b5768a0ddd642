// A complete headset for macs-zenoh in one file: it joins a gateway, registers all four kinds of nodes of docs/unity.md,
// comes back by itself after a lost connection, and shows what was refused.
//
// In Unity: put this file into Assets, make one MacsHeadset when the scene starts, and call Dispatch() in Update().
// Handlers then run in Unity's main thread. Messages are CDR bytes: use the serializer of your generated message
// classes, or CdrWriter and CdrReader below for simple ones.
//
// Outside Unity it is a program:  mcs -r:System.Runtime.Serialization MacsHeadset.cs
//                                 mono MacsHeadset.exe 127.0.0.1 7000
using System;
using System.Collections.Concurrent;
using System.Collections.Generic;
using System.IO;
using System.Net.Sockets;
using System.Runtime.Serialization;
using System.Runtime.Serialization.Json;
using System.Text;
using System.Threading;
using System.Threading.Tasks;

namespace Macs
{
    // What exists on the robot (docs/protocol.md, node types).
    public enum NodeType { Subscriber = 1, Publisher = 2, Client = 3, Service = 4 }

    public sealed class MacsHeadset : IDisposable
    {
        const int Headset = 2, Robot = 1;       // agent types
        const int HeaderBytes = 39;
        const double HeartbeatS = 4.0;          // the gateway wants a sign of life; existing programs send one after 5 s
        const int AnswerMs = 5000;
        const int MaxMessageBytes = 256 << 20;  // no gateway sends so much: behind such a size no message can be found

        public event Action<int> Connected = id => { };
        public event Action<string> Disconnected = reason => { };
        // Robot, topic or service, reason: a sentence for the person with the headset.
        public event Action<int, string, string> Refused = (robot, name, reason) => { };
        // A message that could not be read, or whose handler failed. It costs that message and nothing else.
        public event Action<Exception> Failed = error => { };

        public int Id { get; private set; }
        // Messages from the gateway that may wait for Dispatch; while that many wait, it reads no more.
        public int MaxWaiting = 64;

        readonly string host;
        readonly int port, group;
        readonly object writing = new object();
        readonly Dictionary<string, Node> nodes = new Dictionary<string, Node>();
        readonly Dictionary<uint, TaskCompletionSource<byte[]>> calls = new Dictionary<uint, TaskCompletionSource<byte[]>>();
        readonly ConcurrentQueue<Action> waiting = new ConcurrentQueue<Action>();
        readonly Timer heartbeat;
        NetworkStream stream;
        DateTime lastWrite = DateTime.UtcNow;
        int nextRequest;
        volatile bool closed;

        public MacsHeadset(string host, int port, int group = 0)
        {
            this.host = host;
            this.port = port;
            this.group = group;
            heartbeat = new Timer(_ => BeatIfSilent(), null, 1000, 1000);
            new Thread(Run) { IsBackground = true, Name = "macs-headset" }.Start();
        }

        // ---- the four kinds of nodes ------------------------------------------------------------------------------

        // 1: receive a topic of these robots and groups. The handler gets the robot's id and the message.
        public void Subscribe(string topic, string type, Action<int, byte[]> handler, int[] robots = null,
                              int[] groups = null, int bufferSize = 10, bool dropNew = false)
        {
            Add(new Node(NodeType.Subscriber, topic, type, robots, groups) {
                OnMessage = handler, BufferSize = bufferSize, DropNew = dropNew });
        }

        // 2: send to a topic. Advertise first, some time before the first message that matters.
        public void Advertise(string topic, string type, int[] robots = null, int[] groups = null, bool latched = false)
        {
            Add(new Node(NodeType.Publisher, topic, type, robots, groups) { Latched = latched });
        }

        // Throws IOException while there is no connection: a command that comes late must not be sent.
        public void Publish(string topic, byte[] message)
        {
            Node node = Find(topic);
            Write(ToAgents(node.Robots, node.Groups, node.Metadata(Id, 0), message));
        }

        // 3: call a service that runs on a robot. Fails with TimeoutException or, with a reason, InvalidOperationException.
        public async Task<byte[]> Call(string service, string type, int robot, byte[] request)
        {
            lock (nodes)
                if (!nodes.ContainsKey(NodeName(service)))
                    Add(new Node(NodeType.Client, service, type, new[] { robot }, null));
            uint number = (uint)Interlocked.Increment(ref nextRequest);
            var answer = new TaskCompletionSource<byte[]>();
            lock (calls) calls[number] = answer;
            Metadata metadata = Find(service).Metadata(Id, number);
            metadata.MessageManager = "InterfaceCallFailure";   // tell me why, when there is no answer
            Write(ToAgents(new[] { robot }, new int[0], metadata, request));
            bool inTime = await Task.WhenAny(answer.Task, Task.Delay(AnswerMs)) == answer.Task;
            lock (calls) calls.Remove(number);
            if (!inTime) throw new TimeoutException(service + " on robot " + robot + " did not answer");
            return await answer.Task;
        }

        // 4: answer calls of ROS nodes on these robots. One headset per service and robot.
        public void Serve(string service, string type, Func<byte[], byte[]> handler, int[] robots = null, int[] groups = null)
        {
            Add(new Node(NodeType.Service, service, type, robots, groups) { OnCall = handler });
        }

        public void Remove(string name)
        {
            Node node = Find(name);
            lock (nodes) nodes.Remove(node.Name);
            Register(node, "InterfaceNodeRemover");
        }

        // Run the handlers of what has come. In Unity: from Update().
        public void Dispatch()
        {
            Action next;
            for (int left = waiting.Count; left > 0 && waiting.TryDequeue(out next); left--)
            {
                try { next(); }
                catch (Exception error) { Failed(error); }
            }
        }

        public void Dispose()
        {
            closed = true;
            heartbeat.Dispose();
            TryWrite(Frame(0, null, null, Json(new GoOffline { AgentId = Id }), new byte[8]));
            NetworkStream open = stream;
            if (open != null) open.Close();
        }

        // ---- the connection ---------------------------------------------------------------------------------------

        void Run()
        {
            for (int pauseMs = 250; !closed; pauseMs = Math.Min(2 * pauseMs, 4000))
            {
                try
                {
                    using (var client = new TcpClient(host, port) { NoDelay = true })
                    {
                        stream = client.GetStream();
                        while (true)
                        {
                            Receive();
                            pauseMs = 250;
                            while (waiting.Count >= MaxWaiting && !closed) Thread.Sleep(5);
                        }
                    }
                }
                catch (Exception error) when (error is IOException || error is SocketException || error is ObjectDisposedException)
                {
                    stream = null;
                    if (!closed && Id != 0) { string why = error.Message; waiting.Enqueue(() => Disconnected(why)); }
                    Id = 0;
                }
                if (!closed) Thread.Sleep(pauseMs);
            }
        }

        // One message: u32 S, S bytes of metadata, u32 D, D bytes of data.
        void Receive()
        {
            byte[] metadataBytes = ReadExactly(ReadSize());
            byte[] data = ReadExactly(ReadSize());
            try { Handle(metadataBytes, data); }
            catch (Exception error) when (!(error is IOException)) { waiting.Enqueue(() => Failed(error)); }
        }

        // Throws what the JSON reader throws: the message is lost, the one behind it is not.
        void Handle(byte[] metadataBytes, byte[] data)
        {
            var metadata = FromJson<Metadata>(metadataBytes);
            if (!string.IsNullOrEmpty(metadata.NodeName)) Deliver(metadata, data);
            else if (metadata.MessageManager == "AgentConfigurer") Configure(metadata, FromJson<Welcome>(data));
            else if (metadata.MessageManager == "InterfaceNodeRefused")
            {
                var refusal = FromJson<NodeRefused>(data);
                waiting.Enqueue(() => Refused(refusal.RobotId, refusal.TosName, refusal.Reason));
            }
            // whatever else a gateway says is for programs that know it
        }

        // The first message on each connection gives the id; a later one changes it. Both are answered.
        void Configure(Metadata metadata, Welcome welcome)
        {
            Id = welcome.AgentId;
            var reply = new Configuration { AgentId = Id, AgentType = Headset, GroupId = group, RequestId = metadata.RequestId };
            Write(Frame(0, null, null, Json(reply), new byte[8]));
            Node[] known;
            lock (nodes) { known = new Node[nodes.Count]; nodes.Values.CopyTo(known, 0); }
            foreach (Node node in known) Register(node, "InterfaceNodeAdder");
            int id = Id;
            waiting.Enqueue(() => Connected(id));
        }

        void Deliver(Metadata metadata, byte[] data)
        {
            Node node;
            lock (nodes) if (!nodes.TryGetValue(metadata.NodeName, out node)) return;
            if (metadata.NodeType != (int)node.Type || metadata.SenderAgentType != Robot) return;
            int robot = metadata.SenderAgentId ?? 0;
            if (node.Type == NodeType.Subscriber) waiting.Enqueue(() => node.OnMessage(robot, data));
            else if (node.Type == NodeType.Client) Answered(metadata, data);
            else if (node.Type == NodeType.Service)
                waiting.Enqueue(() => TryWrite(ToAgents(new[] { robot }, new int[0], node.Metadata(Id, metadata.RequestId), node.OnCall(data))));
        }

        void Answered(Metadata metadata, byte[] data)
        {
            TaskCompletionSource<byte[]> call;
            lock (calls) if (!calls.TryGetValue(metadata.RequestId, out call)) return;
            if (metadata.MessageManager == "InterfaceCallFailure")
                call.TrySetException(new InvalidOperationException(FromJson<CallFailure>(data).Reason));
            else call.TrySetResult(data);
        }

        void BeatIfSilent()
        {
            if (Id == 0 || (DateTime.UtcNow - lastWrite).TotalSeconds < HeartbeatS) return;
            TryWrite(Frame(0, null, null, Json(new Heartbeat()), new byte[8]));
        }

        void Write(byte[] frame)
        {
            NetworkStream open = stream;
            if (open == null) throw new IOException("not connected");
            try { lock (writing) { open.Write(frame, 0, frame.Length); lastWrite = DateTime.UtcNow; } }
            catch (ObjectDisposedException) { throw new IOException("not connected"); }
        }

        // What need not be told when it fails: Run notices as well, connects again, and registers all nodes.
        void TryWrite(byte[] frame)
        {
            try { Write(frame); }
            catch (IOException) { }
        }

        int ReadSize()
        {
            int size = BitConverter.ToInt32(ReadExactly(4), 0);
            if (size < 0 || size > MaxMessageBytes) throw new IOException("the gateway declared " + (uint)size + " bytes");
            return size;
        }

        byte[] ReadExactly(int size)
        {
            var bytes = new byte[size];
            for (int have = 0; have < size; )
            {
                int got = stream.Read(bytes, have, size - have);
                if (got == 0) throw new IOException("the gateway closed the connection");
                have += got;
            }
            return bytes;
        }

        // ---- frames -----------------------------------------------------------------------------------------------

        void Add(Node node)
        {
            lock (nodes) nodes[node.Name] = node;
            if (Id != 0) Register(node, "InterfaceNodeAdder");     // else Configure does it
        }

        Node Find(string topic)
        {
            lock (nodes) return nodes[NodeName(topic)];
        }

        void Register(Node node, string manager)
        {
            var management = new Registration {
                RegistrantAgentId = Id, RegistrarAgentIds = node.Robots, RegistrarGroupIds = node.Groups,
                NodeType = (int)node.Type, NodeName = node.Name, TosName = node.Topic, DataExchangeType = node.DataType };
            var data = new InterfaceNode {
                RegistrantAgentType = Headset, RegistrantAgentId = Id, NodeType = (int)node.Type, NodeName = node.Name,
                TosName = node.Topic, DataExchangeType = node.DataType, BufferSize = node.BufferSize,
                DropNew = node.DropNew, IsLatched = node.Latched };
            var metadata = new Metadata { SenderAgentType = Headset, SenderAgentId = Id, MessageManager = manager };
            TryWrite(Frame(0, null, null, Json(management), Message(Json(metadata), Json(data))));
        }

        static byte[] ToAgents(int[] robots, int[] groups, Metadata metadata, byte[] data)
        {
            return Frame(Robot, robots, groups, new byte[0], Message(Json(metadata), data));
        }

        // u8 agent type, 10 x u16 ids, 10 x u8 groups, u32 size of the management data, u32 size of the message.
        static byte[] Frame(int agentType, int[] ids, int[] groups, byte[] management, byte[] message)
        {
            var frame = new byte[HeaderBytes + management.Length + message.Length];
            frame[0] = (byte)agentType;
            for (int i = 0; ids != null && i < ids.Length; i++) BitConverter.GetBytes((ushort)ids[i]).CopyTo(frame, 1 + 2 * i);
            for (int i = 0; groups != null && i < groups.Length; i++) frame[21 + i] = (byte)groups[i];
            BitConverter.GetBytes(management.Length).CopyTo(frame, 31);
            BitConverter.GetBytes(message.Length).CopyTo(frame, 35);
            management.CopyTo(frame, HeaderBytes);
            message.CopyTo(frame, HeaderBytes + management.Length);
            return frame;
        }

        static byte[] Message(byte[] metadata, byte[] data)
        {
            var message = new byte[8 + metadata.Length + data.Length];
            BitConverter.GetBytes(metadata.Length).CopyTo(message, 0);
            metadata.CopyTo(message, 4);
            BitConverter.GetBytes(data.Length).CopyTo(message, 4 + metadata.Length);
            data.CopyTo(message, 8 + metadata.Length);
            return message;
        }

        public static string NodeName(string topic) { return "nd_" + topic.Replace('/', '_').Replace('~', '_'); }

        static byte[] Json<T>(T value)
        {
            using (var bytes = new MemoryStream())
            {
                new DataContractJsonSerializer(typeof(T)).WriteObject(bytes, value);
                return bytes.ToArray();
            }
        }

        static T FromJson<T>(byte[] bytes)
        {
            using (var stream = new MemoryStream(bytes))
                {
                var value = (T)new DataContractJsonSerializer(typeof(T)).ReadObject(stream);
                if (value == null) throw new SerializationException("null is no " + typeof(T).Name);
                return value;
            }
        }

        sealed class Node
        {
            public readonly NodeType Type;
            public readonly string Topic, DataType, Name;
            public readonly int[] Robots, Groups;
            public Action<int, byte[]> OnMessage;
            public Func<byte[], byte[]> OnCall;
            public int BufferSize = 10;
            public bool DropNew, Latched;

            public Node(NodeType type, string topic, string dataType, int[] robots, int[] groups)
            {
                Type = type;
                Topic = topic;
                DataType = dataType;
                Name = NodeName(topic);
                Robots = robots ?? new int[0];
                Groups = groups ?? new int[0];
            }

            public Metadata Metadata(int id, uint request)
            {
                return new Metadata {
                    SenderAgentType = Headset, SenderAgentId = id, RequestId = request, NodeType = (int)Type,
                    NodeName = Name, DataExchangeType = DataType };
            }
        }
    }

    // ---- JSON, as docs/protocol.md has it -----------------------------------------------------------------------

    [DataContract] class Metadata
    {
        [DataMember(Name = "senderAgentType")] public int? SenderAgentType;
        [DataMember(Name = "senderAgentId")] public int? SenderAgentId;
        [DataMember(Name = "requestId")] public uint RequestId;
        [DataMember(Name = "messageManager")] public string MessageManager = "";
        [DataMember(Name = "nodeType")] public int NodeType;
        [DataMember(Name = "nodeName")] public string NodeName = "";
        [DataMember(Name = "dataExchangeType")] public string DataExchangeType = "";
    }

    [DataContract] class Welcome { [DataMember(Name = "agentId", IsRequired = true)] public ushort AgentId; }

    [DataContract] class Configuration
    {
        [DataMember(Name = "messageManager")] public string MessageManager = "AgentclientConfigurer";
        [DataMember(Name = "agentType")] public int AgentType;
        [DataMember(Name = "agentId")] public int AgentId;
        [DataMember(Name = "groupId")] public int GroupId;
        [DataMember(Name = "requestId")] public uint RequestId;
        // "I read what newer gateways say": an existing program leaves it out (docs/protocol.md).
        [DataMember(Name = "extensions")] public int Extensions = 1;
    }

    [DataContract] class Heartbeat { [DataMember(Name = "messageManager")] public string MessageManager = "HeartbeatHandler"; }

    [DataContract] class GoOffline
    {
        [DataMember(Name = "messageManager")] public string MessageManager = "UnityAgentclientRemover";
        [DataMember(Name = "agentId")] public int AgentId;
    }

    [DataContract] class Registration
    {
        [DataMember(Name = "messageManager")] public string MessageManager = "RosAgentNodeRegistrationForwarder";
        [DataMember(Name = "registrantAgentId")] public int RegistrantAgentId;
        [DataMember(Name = "registrarAgentIds")] public int[] RegistrarAgentIds;
        [DataMember(Name = "registrarGroupIds")] public int[] RegistrarGroupIds;
        [DataMember(Name = "nodeType")] public int NodeType;
        [DataMember(Name = "nodeName")] public string NodeName;
        [DataMember(Name = "tosName")] public string TosName;
        [DataMember(Name = "dataExchangeType")] public string DataExchangeType;
    }

    [DataContract] class InterfaceNode
    {
        [DataMember(Name = "registrantAgentType")] public int RegistrantAgentType;
        [DataMember(Name = "registrantAgentId")] public int RegistrantAgentId;
        [DataMember(Name = "nodeType")] public int NodeType;
        [DataMember(Name = "nodeName")] public string NodeName;
        [DataMember(Name = "tosName")] public string TosName;
        [DataMember(Name = "dataExchangeType")] public string DataExchangeType;
        [DataMember(Name = "bufferSize")] public int BufferSize;
        [DataMember(Name = "dropNew")] public bool DropNew;
        [DataMember(Name = "isLatched")] public bool IsLatched;
        // What is sent and read here is what Unity's serializer makes and takes; false: just as ROS does (docs/robot.md).
        [DataMember(Name = "unityCdr")] public bool UnityCdr = true;
    }

    [DataContract] class NodeRefused
    {
        [DataMember(Name = "robotId")] public int RobotId;
        [DataMember(Name = "tosName")] public string TosName;
        [DataMember(Name = "reason")] public string Reason;
    }

    [DataContract] class CallFailure { [DataMember(Name = "reason")] public string Reason; }

    // ---- CDR, for simple messages ---------------------------------------------------------------------------------

    // Writes fields in the order of the .msg file. Numbers stand at multiples of their size, counted after the header.
    public sealed class CdrWriter
    {
        readonly MemoryStream bytes = new MemoryStream();

        public CdrWriter() { bytes.Write(new byte[] { 0, 1, 0, 0 }, 0, 4); }

        public CdrWriter Bool(bool value) { bytes.WriteByte(value ? (byte)1 : (byte)0); return this; }
        public CdrWriter Int32(int value) { return Number(BitConverter.GetBytes(value)); }
        public CdrWriter Float32(float value) { return Number(BitConverter.GetBytes(value)); }
        public CdrWriter Float64(double value) { return Number(BitConverter.GetBytes(value)); }

        public CdrWriter String(string value)
        {
            byte[] text = Encoding.UTF8.GetBytes(value);
            Int32(text.Length + 1);
            bytes.Write(text, 0, text.Length);
            bytes.WriteByte(0);
            return this;
        }

        public byte[] ToArray() { return bytes.ToArray(); }

        CdrWriter Number(byte[] value)
        {
            while ((bytes.Length - 4) % value.Length != 0) bytes.WriteByte(0);
            bytes.Write(value, 0, value.Length);
            return this;
        }
    }

    public sealed class CdrReader
    {
        readonly byte[] bytes;
        int at = 4;

        public CdrReader(byte[] bytes) { this.bytes = bytes; }

        public bool Bool() { return bytes[at++] != 0; }
        public int Int32() { return BitConverter.ToInt32(bytes, Next(4)); }
        public float Float32() { return BitConverter.ToSingle(bytes, Next(4)); }
        public double Float64() { return BitConverter.ToDouble(bytes, Next(8)); }

        public string String()
        {
            int size = Int32();
            string text = Encoding.UTF8.GetString(bytes, at, size - 1);
            at += size;
            return text;
        }

        int Next(int size)
        {
            at += (size - (at - 4) % size) % size;
            at += size;
            return at - size;
        }
    }

#if !UNITY_5_3_OR_NEWER
    // Talks with robot 1: receives /chatter, sends to /talk, calls /set, and answers /ask. Every line says what happened.
    static class Example
    {
        static int Main(string[] args)
        {
            if (args.Length < 2)
            {
                Console.Error.WriteLine("usage: MacsHeadset.exe HOST PORT [SECONDS]");
                return 2;
            }
            double seconds = args.Length > 2 ? double.Parse(args[2], System.Globalization.CultureInfo.InvariantCulture) : 3600;
            using (var headset = new MacsHeadset(args[0], int.Parse(args[1])))
            {
                int[] robot = { 1 };
                headset.Connected += id => Say("connected as headset " + id);
                headset.Disconnected += reason => Say("disconnected: " + reason);
                headset.Failed += error => Say("a message was lost: " + error.Message);
                headset.Refused += (id, name, reason) => Say("robot " + id + " refused " + name + ": " + reason);
                headset.Subscribe("/chatter", "std_msgs/String",
                    (id, message) => Say("/chatter of robot " + id + ": " + new CdrReader(message).String()), robot);
                headset.Subscribe("/nothing", "no_such_msgs/Thing", (id, message) => { }, robot);
                headset.Advertise("/talk", "std_msgs/String", robot);
                headset.Serve("/ask", "std_srvs/SetBool", request =>
                {
                    bool asked = new CdrReader(request).Bool();
                    Say("/ask: " + asked);
                    return new CdrWriter().Bool(true).String("headset says " + asked).ToArray();
                }, robot);
                Task asking = null;
                DateTime end = DateTime.UtcNow.AddSeconds(seconds), next = DateTime.UtcNow;
                while (DateTime.UtcNow < end)
                {
                    headset.Dispatch();
                    if (headset.Id != 0 && DateTime.UtcNow >= next)
                    {
                        next = DateTime.UtcNow.AddMilliseconds(200);
                        try { headset.Publish("/talk", new CdrWriter().String("hello from C#").ToArray()); }
                        catch (IOException) { }     // it connects again
                        if (asking == null || asking.IsCompleted) asking = Set(headset);
                    }
                    Thread.Sleep(5);
                }
            }
            return 0;
        }

        static async Task Set(MacsHeadset headset)
        {
            try
            {
                var response = new CdrReader(await headset.Call("/set", "std_srvs/SetBool", 1, new CdrWriter().Bool(true).ToArray()));
                Say("/set: " + response.Bool() + " " + response.String());
            }
            catch (Exception error) { Say("/set: " + error.Message); }
        }

        static void Say(string line) { Console.WriteLine(line); Console.Out.Flush(); }
    }
#endif
}
