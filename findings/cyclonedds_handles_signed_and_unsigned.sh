#!/bin/sh
# Cyclone DDS for Python gives the handle of one writer as two numbers: negative in one place, positive in another.
#
# Versions: cyclonedds 11.0.1; Python 3.12, Linux, x86-64.
#
# A reader receives one sample from each of 40 writers. `sample_info.publication_handle` identifies the writer among those
# that `DataReader.get_matched_publications()` returns. The first is read as an unsigned number of 64 bits, the second as
# a signed one. Handles are random, so for about half of all writers the two differ by 2**64.
#
# Expected: the handle of a sample's writer is one of the matched writers.
#
# Output seen (handles are other ones each time):
#   cyclonedds 11.0.1
#   40 samples; of 22 the writer is not among the matched ones; modulo 2**64 of 0
#   for example 16775716670946378621, where the only matched writer is -1671027402763172995
#
# Exit status: 0 if it behaves like this, 1 if it does not any more.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check cyclonedds==11.0.1
cat > "$folder/handles.py" <<'EOF'
import sys
import time
from dataclasses import dataclass
from importlib.metadata import version

from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic


@dataclass
class Number(IdlStruct):
    value: int


participant = DomainParticipant(0)
topic = Topic(participant, "numbers", Number)
print("cyclonedds", version("cyclonedds"))
pairs = []
for value in range(40):
    reader, writer = DataReader(participant, topic), DataWriter(participant, topic)
    while not reader.get_matched_publications():
        time.sleep(0.001)
    writer.write(Number(value))
    (sample,) = reader.take(10)
    pairs.append((sample.sample_info.publication_handle, reader.get_matched_publications()))
    del reader, writer, sample
missing = [(handle, matched) for handle, matched in pairs if handle not in matched]
modulo = [handle for handle, matched in pairs if handle % 2**64 not in [one % 2**64 for one in matched]]
print(f"{len(pairs)} samples; of {len(missing)} the writer is not among the matched ones; modulo 2**64 of {len(modulo)}")
for handle, matched in missing[:1]:
    print(f"for example {handle}, where the only matched writer is {matched[0]}")
sys.exit(int(not missing or bool(modulo)))
EOF
cat > "$folder/loopback.xml" <<'EOF'
<CycloneDDS><Domain Id="any"><General><Interfaces><NetworkInterface name="lo"/></Interfaces>
<AllowMulticast>false</AllowMulticast></General></Domain></CycloneDDS>
EOF
CYCLONEDDS_URI="file://$folder/loopback.xml" "$folder/venv/bin/python" "$folder/handles.py"
