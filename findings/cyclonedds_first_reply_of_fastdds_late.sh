#!/bin/sh
# A reliable reader of Cyclone DDS receives the first reply of a ROS 2 service on Fast DDS late or never; best effort at once.
#
# Versions: cyclonedds 11.0.1; ros-rclpy 9.1.2 (ROS 2 Kilted, Fast DDS 3.2.3); Python 3.12, Linux, x86-64.
#
# A rclpy node serves std_srvs/SetBool. Clients on Cyclone DDS, each a process of its own on the loopback interface, wait
# until their writer of requests and their reader of replies are matched, wait 0.5 s more, and send a request, and a second
# one 1.2 s later. The server's replies are reliable and volatile. With a reliable reader the first reply is often not
# there after 1.2 s: it comes after seconds, together with the second one, or never. The server has called its function
# each time. With a best-effort reader every reply is there. Cyclone DDS knows from where on to accept samples of such a
# writer when it has received a heartbeat of it, which Fast DDS sends seconds after the match.
#
# Expected: what is sent 0.5 s after a reliable writer and a reliable reader have matched arrives, and soon.
#
# Output seen (the numbers vary):
#   best effort: of 6 clients 6 had the first reply within 1.2 s, 6 the second
#   reliable: of 6 clients 0 had the first reply within 1.2 s, 5 the second
#
# Exit status: 0 if it behaves like this, 1 if it does not any more.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
for name in ros cyclone; do "${PYTHON:-python3}" -m venv "$folder/$name"; done
"$folder/ros/bin/pip" install --quiet --disable-pip-version-check 'ros-rclpy[fastrtps]==9.1.2' ros-std-srvs==5.5.1
"$folder/cyclone/bin/pip" install --quiet --disable-pip-version-check cyclonedds==11.0.1
cat > "$folder/server.py" <<'EOF'
import ctypes
import signal

import rclpy
from std_srvs.srv import SetBool

ctypes.CDLL(None).prctl(1, signal.SIGKILL, 0, 0, 0)  # ends with its parent
rclpy.init()
node = rclpy.create_node("server")
node.create_service(SetBool, "/switch", lambda request, response: SetBool.Response(success=True))
print("ready", flush=True)
rclpy.spin(node)
EOF
cat > "$folder/client.py" <<'EOF'
import sys
import time
from dataclasses import dataclass

from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic


@dataclass
class Request(IdlStruct, typename="std_srvs::srv::dds_::SetBool_Request_"):
    data: bool


@dataclass
class Reply(IdlStruct, typename="std_srvs::srv::dds_::SetBool_Response_"):
    success: bool
    message: str


reliable = Policy.Reliability.Reliable(10**8)
wanted = reliable if sys.argv[1] == "reliable" else Policy.Reliability.BestEffort
kept = Policy.Durability.Volatile, Policy.History.KeepLast(10)
participant = DomainParticipant(91)
reader = DataReader(participant, Topic(participant, "rr/switchReply", Reply), Qos(wanted, *kept))
writer = DataWriter(participant, Topic(participant, "rq/switchRequest", Request), Qos(reliable, *kept))
while not reader.get_matched_publications() or not writer.get_matched_subscriptions():
    time.sleep(0.01)
time.sleep(0.5)
for _ in range(2):
    writer.write(Request(True))
    time.sleep(1.2)
    print(int(any(isinstance(sample, Reply) for sample in reader.take(10))), end=" ")
EOF
cat > "$folder/compare.py" <<'EOF'
import os
import subprocess
import sys

folder = sys.argv[1]
server = subprocess.Popen([f"{folder}/ros/bin/python", f"{folder}/server.py"], stdout=subprocess.PIPE, text=True)
assert server.stdout.readline() == "ready\n"
firsts = {}
for reliability in ("best effort", "reliable"):
    command = [f"{folder}/cyclone/bin/python", f"{folder}/client.py", reliability]
    had = [subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout.split() for _ in range(6)]
    firsts[reliability], seconds = (sum(int(one[place]) for one in had) for place in (0, 1))
    print(
        f"{reliability}: of {len(had)} clients {firsts[reliability]} had the first reply within 1.2 s, {seconds} the second",
        flush=True,
    )
server.kill()
sys.exit(int(firsts["reliable"] >= firsts["best effort"]))
EOF
cat > "$folder/loopback.xml" <<'EOF'
<CycloneDDS><Domain Id="any"><General><Interfaces><NetworkInterface name="lo"/></Interfaces>
<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>
<Peers><Peer address="127.0.0.1"/></Peers></Discovery></Domain></CycloneDDS>
EOF
export ROS_DOMAIN_ID=91 ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST CYCLONEDDS_URI="file://$folder/loopback.xml"
"$folder/cyclone/bin/python" "$folder/compare.py" "$folder"
