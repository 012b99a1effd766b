#!/bin/sh
# Name what a bare Debian lacks, with the one apt line that mends it. Usage: check_system.sh PYTHON
set -u
python=$1
missing=""

command -v "$python" >/dev/null 2>&1 || missing="$missing python3.11"
# Newer systems have no package of Python 3.11, and uv brings one.
if [ -n "$missing" ] && command -v uv >/dev/null 2>&1; then
  echo "there is no $python; uv has one:" >&2
  echo "    uv python install 3.11 && make PYTHON=\"\$(uv python find 3.11)\" ..." >&2
fi
if [ -z "$missing" ]; then
  "$python" -c 'import ensurepip, venv' 2>/dev/null || missing="$missing python3.11-venv"
  "$python" -c 'import os, sysconfig; os.stat(sysconfig.get_path("include") + "/Python.h")' 2>/dev/null ||
    missing="$missing python3.11-dev"
fi
# The core is C++20.
echo 'int main() { return [](auto x) requires true { return x; }(0); }' |
  ${CXX:-g++} -std=c++20 -x c++ -fsyntax-only - 2>/dev/null || missing="$missing g++"
# Blender's wheel is linked against these although it opens no window.
libraries=$(/sbin/ldconfig -p 2>/dev/null)
for pair in libX11.so.6:libx11-6 libXrender.so.1:libxrender1 libXfixes.so.3:libxfixes3 libXi.so.6:libxi6 \
  libxkbcommon.so.0:libxkbcommon0 libSM.so.6:libsm6 libICE.so.6:libice6 libXext.so.6:libxext6 libxcb.so.1:libxcb1 \
  libXt.so.6:libxt6 libGL.so.1:libgl1; do
  case "$libraries" in
  *"${pair%%:*}"*) ;;
  *) missing="$missing ${pair##*:}" ;;
  esac
done

[ -z "$missing" ] && exit 0
echo "stickslip needs system packages that are not here. On Debian 12:" >&2
echo "    apt-get update && apt-get install -y --no-install-recommends$missing" >&2
exit 1
