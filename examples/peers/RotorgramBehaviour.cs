// How a Unity script flies: put this on a GameObject with a Rigidbody of mass 20 and no drag.

#if UNITY_5_3_OR_NEWER
using System.Net;
using UnityEngine;

namespace Rotorgram
{
    [RequireComponent(typeof(Rigidbody))]
    public sealed class RotorgramBehaviour : MonoBehaviour
    {
        public string server = "127.0.0.1";
        public int serverPort = 8001, port = 8000;
        RotorgramLink link;

        void Start()
        {
            Physics.simulationMode = SimulationMode.Script; // lock-step: time passes in Move alone
            Physics.gravity = new Vector3(0, -9.8f, 0);
            link = new RotorgramLink(
                new RigidbodyDrone(GetComponent<Rigidbody>()),
                new IPEndPoint(IPAddress.Parse(server), serverPort),
                new IPEndPoint(IPAddress.Loopback, port));
        }

        void FixedUpdate()
        {
            link.Tick(); // at most one step: real time. To train faster, call it more often.
            if (link.State != LinkState.Closed) return;
            Debug.Log(link.Ending);
            enabled = false;
        }

        void OnDestroy()
        {
            if (link != null) link.Dispose();
        }

        /// <summary>The task of PointMassDrone, moved by PhysX.</summary>
        sealed class RigidbodyDrone : PointMassDrone
        {
            readonly Rigidbody body;

            public RigidbodyDrone(Rigidbody body) { this.body = body; }

            protected override void Place(double height)
            {
                body.transform.SetPositionAndRotation(
                    new Vector3(0, (float)height, 0), Quaternion.identity);
                body.velocity = body.angularVelocity = Vector3.zero; // Unity 6: linearVelocity
                Physics.SyncTransforms();
                Read();
            }

            protected override void Move(double force)
            {
                for (int i = 0; i < Substeps; i++)
                {
                    body.AddForce(new Vector3(0, (float)force, 0));
                    Physics.Simulate((float)PhysicsStep);
                }
                Read();
            }

            void Read()
            {
                Height = body.position.y;
                ClimbRate = body.velocity.y;
            }
        }
    }
}
#endif
