#!/usr/bin/env bash
# Do what users do, from a wheel and outside of the repository: tests/users/run.sh WHEEL PLACE
set -euo pipefail

wheel=$(realpath "$1") place=$(realpath "$2") home=$(dirname "$(realpath "$0")")
export JAX_COMPILATION_CACHE_DIR="$place/compiled" JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS=0
export XLA_FLAGS=${XLA_FLAGS---xla_backend_optimization_level=0} # compiling takes most of the time, as in the tests
mkdir "$place/users"
cp "$home"/*.py "$home/../../examples/ros2_node.py" "$place/users"
cp -r "$home/package" "$place/package"
python3 -m venv "$place/user"
"$place/user/bin/python" "$home/modules.py" "$home/../../docs" "$place/users" "$place/package"
"$place/user/bin/pip" install --quiet "${wheel}[train]" "$place/package"
for script in tasks agents runs details robots; do # each in a folder of its own
  if [ $script = robots ]; then "$place/user/bin/pip" install --quiet "${wheel}[train,deploy]"; fi
  cp -r "$place/users" "$place/$script"
  (cd "$place/$script" && ../user/bin/python $script.py)
done
