#!/bin/sh
# Lose a share of all datagrams that come in at one address of this network namespace: lossy_radio NAME PER_MILLE
#
# The kernel's packet filter does it, before any socket sees them; needs NET_ADMIN in the namespace, nothing more.
set -eu
address=$(getent ahostsv4 "$1" | { read -r first _; echo "$first"; })
nft -f - <<RULES
table ip lossy_radio
delete table ip lossy_radio
table ip lossy_radio {
    chain in {
        type filter hook input priority 0; policy accept;
        ip daddr $address numgen random mod 1000 < $2 counter drop
    }
}
RULES
echo "lossy radio: $2 of 1000 datagrams to $1 ($address) are lost"
trap 'nft list table ip lossy_radio; exit 0' TERM INT
while :; do sleep 1; done
