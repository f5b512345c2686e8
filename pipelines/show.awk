# The settings of a pipeline as a table: awk -v name=raster -f show.awk DEFAULTS raster.just stages.just, with what
# `just --evaluate` prints as DEFAULTS. The comment above settings says what they are, for all of them up to the next
# blank line; the unit is the end of the name. Of a setting in two files the first counts, as in `just`.

BEGIN {
    WIDTH = 110
    INDENT = 65
    n = split("nm2_per_s:nm^2/s s_per_mm:s/mm mm_per_s:mm/s mm2:mm^2 mm:mm nm:nm s:s deg:degree percent:%", ends, " ")
}

FNR == 1 { file++; comment = ""; head = (file == 2); hidden = 0 }

# name := "value", with \n, \" and \\ in the value
file == 1 {
    at = index($0, ":=")
    value = substr($0, at + 3)
    key = $1
    defaults[key] = value ~ /^"/ ? substr(value, 2, length(value) - 2) : value
    next
}

/^# --- / { nextfile }

/^#/ {
    line = substr($0, 3)
    if (head) title = title == "" ? line : title " " line
    comment = comment == "" ? line : comment " " line
    next
}

/^$/ || /^#$/ { head = 0; comment = ""; shared = 0; hidden = 0; next }

/^\[private\]/ { hidden = 1; next }

/^[a-z][a-z0-9_]* *:=/ {
    head = 0
    if (hidden) { hidden = 0; comment = ""; seen[$1] = 1; next }
    if (!($1 in seen)) {
        seen[$1] = 1
        if (comment == "" && shared) comment = "as above"
        row($1, comment)
    }
    if (comment != "") shared = 1
    comment = ""
    next
}

{ hidden = 0; head = 0 }

function unit(key,    i, pair) {
    for (i = 1; i <= n; i++) {
        split(ends[i], pair, ":")
        if (key ~ ("_" pair[1] "$")) return pair[2]
    }
    return ""
}

function row(key, what,    words, count, i, line) {
    if (!headed++) {
        sub(/ *Every line that runs .*/, "", title)
        print name ": " title "\n"
        printf "%-22s %-33s %-7s %s\n", "setting", "default", "unit", "what"
        printf "%-22s %-33s %-7s %s\n", "-------", "-------", "----", "----"
    }
    line = sprintf("%-22s %-33s %-7s", key, defaults[key] == "" ? "(empty)" : defaults[key], unit(key))
    count = split(what, words, " ")
    for (i = 1; i <= count; i++) {
        if (length(line) + 1 + length(words[i]) > WIDTH) {
            print line
            line = sprintf("%-" INDENT - 1 "s", "")
        }
        line = line " " words[i]
    }
    sub(/ +$/, "", line)
    print line
}
