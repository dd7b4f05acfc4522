#!/usr/bin/env bash
# Train environments of other packages with the command line alone, each group in a virtual
# environment of its own over .venv: tests/external/run.sh [STEPS [all|one]], all of them or one of
# each package. One line each; 1 if one failed.
set -euo pipefail
cd "$(dirname "$0")/../.."
steps=${1:-3000}
which=${2:-all}
failed=0

install() { # install NAME: what its list pins, it has instead of what .venv has
  local venv=.venv-external/$1 list=tests/external/requirements-$1.txt
  local stamp=$venv/.installed file stale=
  for file in "$list" constraints.txt pyproject.toml; do
    [[ $stamp -nt $file ]] || stale=1
  done
  [[ -n $stale ]] || return 0
  mkdir -p .venv-external
  { .venv/bin/python -m venv --clear "$venv" &&
    base=$(.venv/bin/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))') &&
    own=$("$venv/bin/python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))') &&
    echo "import site; site.addsitedir('$base')" > "$own/base.pth" &&
    grep -vFf <(sed -n 's/==.*/==/p' "$list") constraints.txt > "$venv/constraints.txt" &&
    "$venv/bin/python" -m pip install --quiet --disable-pip-version-check \
      -c "$venv/constraints.txt" -r "$list" &&
    touch "$stamp"; } > ".venv-external/$1.log" 2>&1
}

last_words() { # last_words FILE: what its last line with words says
  { grep '[[:alpha:]]' "$1" || echo "no last words: $1"; } | tail -n 1 | cut -c 1-240
}

more() { # more NAME ENV [OPTION...]: one that is not tried where one of each package is enough
  [[ $which == one ]] || try "$@"
}

try() { # try NAME ENV [OPTION...]: a line for one environment
  local venv=.venv-external/$1 env=$2 out rate
  if [[ ! -e $venv/.installed ]]; then
    printf '%-48s SKIPPED  %s\n' "$env" "$(last_words ".venv-external/$1.log")"
    return
  fi
  out=$venv/runs/${env//[:\/]/_}
  rm -rf "$out"
  mkdir -p "$out"
  if timeout 600 "$venv/bin/python" -m a2s.cli train --env "$env" "${@:3}" --total-steps "$steps" --json \
    --run-dir "$out/run" > "$out/stdout" 2> "$out/stderr"; then
    # The last line of standard output is the summary, whatever an environment prints.
    rate=$(tail -n 1 "$out/stdout" | sed -n 's/^{.*"env_steps_per_s": \([0-9.]*\).*}$/\1/p')
    if [[ -z $rate ]]; then
      echo "standard output ends with: $(tail -n 1 "$out/stdout")" >> "$out/stderr"
    elif grep -q '^Traceback' "$out/run/actors.log"; then
      echo "traceback in $out/run/actors.log" >> "$out/stderr"
    else
      printf '%-48s ok       %s env steps/s\n' "$env" "$rate"
      return
    fi
  fi
  failed=1
  printf '%-48s FAILED   %s\n' "$env" "$(last_words "$out/stderr")"
}

install mujoco4 || true
try mujoco4 pybullet_envs_gymnasium:HopperBulletEnv-v0
more mujoco4 pybullet_envs_gymnasium:Walker2DBulletEnv-v0
more mujoco4 pybullet_envs_gymnasium:HalfCheetahBulletEnv-v0
try mujoco4 panda_gym:PandaReach-v3
more mujoco4 gymnasium_robotics:AdroitHandDoor-v1
more mujoco4 gymnasium_robotics:PointMaze_UMaze-v3
more mujoco4 BipedalWalker-v3
try mujoco4 LunarLander-v3 --env-kwargs continuous=true

install mujoco3 || true
try mujoco3 shimmy:dm_control/cheetah-run-v0
more mujoco3 shimmy:dm_control/hopper-hop-v0
more mujoco3 shimmy:dm_control/walker-walk-v0
more mujoco3 shimmy:dm_control/reach_site_features-v0
try mujoco3 gymnasium_robotics:FetchReach-v4
more mujoco3 gymnasium_robotics:HandReach-v3
more mujoco3 gymnasium_robotics:FrankaKitchen-v1

exit "$failed"
