#!/bin/sh
# Tries the Python module of an environment: plans from arrays, types and help, and the notebook. try-module.sh PYTHON OUT
# installs what they need beside Planish, and writes to the folders plan, types, notebook and typed in OUT, which must not
# be there. The executed notebook is OUT/notebook.ipynb. The PATH has no Rust toolchain.
set -eu
here=$(cd "$(dirname "$0")" && pwd -P)
python=$(cd "$(dirname "$1")" && pwd -P)/$(basename "$1")
cd "$2"
"$python" -m pip install --quiet xarray h5py matplotlib pandas mypy nbclient ipykernel
mkdir plan types
(cd plan && env -i HOME="$PWD" PATH=/usr/bin:/bin "$python" "$here/try_plan.py")
(cd types && env -i HOME="$PWD" PATH=/usr/bin:/bin "$python" "$here/try_types.py")
env -i HOME="$PWD" PATH=/usr/bin:/bin "$python" "$here/try_notebook.py" "$here/../../docs/notebook.ipynb" notebook.ipynb
