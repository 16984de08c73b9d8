"""Publishes a signal until it is ended: RUNTIME NAME FIELDS(comma separated) HZ. Prints a line once it publishes."""

import sys
import time

import depthrig

runtime, name, fields, rate = sys.argv[1:]
with depthrig.Signal(name, fields.split(","), unit="rad", kind="joints", runtime_dir=runtime) as signal:
    number = 0
    begin = time.monotonic()
    while True:
        number += 1
        signal.publish([number + 0.001 * i for i in range(len(fields.split(",")))])
        if number == 1:
            print("publishing", flush=True)
        time.sleep(max(0.0, begin + number / float(rate) - time.monotonic()))
