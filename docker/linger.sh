#!/bin/sh
# Run a command of fleetloc; if it ends well, stay until the report is written.
#
# `docker compose up --exit-code-from report` stops everything as soon as any container ends, so none may end
# before the report. One that fails ends at once, and with it the flight.
set -eu
fleetloc "$@"
began=$(date +%s)
waited=0
while [ $waited -lt "${LINGER_S:-120}" ]; do
    if [ -f /data/report.json ] && [ "$(stat -c %Y /data/report.json)" -ge "$began" ]; then
        sleep 5 # for the report's own container to end first
        exit 0
    fi
    sleep 1
    waited=$((waited + 1))
done
echo "linger: no report.json within ${LINGER_S:-120} s" >&2
exit 1
