#!/usr/bin/env bash
# Make a certificate authority and a certificate for each name, for mutual TLS between vehicles, router and watchers.
#   ./certificates.sh FOLDER router quad1 quad2 quad3 watch
# The name of a certificate (its CN) is what the router's access control goes by. Keep the keys off other machines.
set -euo pipefail
folder=${1:?folder for the certificates}
shift
mkdir -p "$folder"
cd "$folder"
days=825

if [[ ! -e ca.key ]]; then
  openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -days "$days" -subj "/CN=quadid CA" \
    -addext "basicConstraints=critical,CA:TRUE" -addext "keyUsage=critical,keyCertSign,cRLSign" \
    -keyout ca.key -out ca.pem 2>/dev/null
fi
for name in "$@"; do
  openssl req -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -subj "/CN=$name" \
    -keyout "$name.key" -out "$name.csr" 2>/dev/null
  openssl x509 -req -in "$name.csr" -CA ca.pem -CAkey ca.key -CAcreateserial -days "$days" -out "$name.pem" \
    -extfile <(printf 'subjectAltName=DNS:%s,DNS:localhost,IP:127.0.0.1\nextendedKeyUsage=serverAuth,clientAuth\n' "$name") \
    2>/dev/null
  rm "$name.csr"
done
chmod 600 ./*.key
