#!/bin/sh
# Write constraints.txt and constraints-blender.txt anew: the newest versions that the components' ranges allow,
# installed into fresh environments. Usage: update_constraints.sh PYTHON
set -eu
python=$1
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

# torch: one build for everybody; without a pin, a range takes the newest build with gigabytes of CUDA packages.
# ray: the two environments must hold the very same version. numcodecs: the same, for byte-identical chunks.
# soupsieve: 3.0 needs Python 3.11.5, and Debian 12 has 3.11.2.
cat >"$work/pins.txt" <<PINS
torch==2.13.0
ray==2.60.0
numcodecs==0.16.6
soupsieve<3
PINS

# A local version such as 2.13.0+cpu stands on no public index: only its public part is written.
freeze() { # environment, constraints file, requirements files
  environment=$1 constraints=$2
  shift 2
  "$python" -m venv "$work/$environment"
  for requirements in "$@"; do
    "$work/$environment/bin/python" -m pip install --quiet --disable-pip-version-check -r "$requirements" \
      -c "$work/pins.txt"
  done
  {
    echo "# Written by tools/update_constraints.sh (make constraints); do not edit."
    "$work/$environment/bin/python" -m pip freeze --exclude-editable | grep -v ' @ file:' | sed 's/+.*//'
  } >"$constraints"
}

freeze service constraints.txt requirements.txt requirements-dev.txt
freeze blender constraints-blender.txt requirements-blender.txt
