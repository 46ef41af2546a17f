# Run a command that can write to the folder OWN alone, without a network:
#
#     sh apart.sh OWN [hide FOLDER | show FOLDER] ... -- COMMAND ...
#
# OWN takes the place of the folder above it, where the command starts. Temporary folders, homes,
# sockets and devices are hidden. Steps follow in their order: `hide` hides a folder, and `show`
# shows one that a hidden folder holds. Paths are absolute.
set -e

# In namespaces of its own this is process 1. It ends with the process that started it, and all
# other processes of the namespace with it.
if [ $$ != 1 ]; then
    exec setpriv --pdeathsig KILL unshare --map-root-user --mount --net --ipc --pid --fork \
        --kill-child --mount-proc sh "$0" "$@"
fi

own=$1
place=${own%/*}
shift

# A second view of all files, to which relative paths lead whatever hides the first.
mount --rbind / "$place"
cd "$place"

hide() {
    # What does not exist and cannot be made needs no hiding.
    [ -d "$1" ] || mkdir -p "$1" 2>&- || return 0
    mount -t tmpfs -o size=1g,mode=755 none "$1"
}

show() {
    [ -e ".$1" ] || return 0
    [ -e "$1" ] || mkdir -p "$1"
    mount --no-canonicalize --bind ".$1" "$1"
}

for folder in /home /root /run /tmp /var/tmp /dev /dev/shm; do
    hide $folder
done
for device in /dev/null /dev/zero /dev/full /dev/random /dev/urandom; do
    touch $device
    show $device
done
while [ "$1" != -- ]; do
    "$1" "$2"
    shift 2
done
shift
mkdir -p "$place"
mount --no-canonicalize --bind ".$own" "$place"
cd "$place"

# All mounts but three become read-only. A line has the folder, with blanks as \040, and options.
while read -r _ _ _ _ folder options _; do
    folder=$(printf %b "$folder")
    case $folder in
        "$place" | /tmp | /dev/shm) continue ;;
    esac
    if [ -e "$folder" ]; then
        mount -o "remount,bind,$options,ro" none "$folder"
    fi
done < /proc/self/mountinfo

# In a second namespace of users, where it has no name, the command has no right to mount.
exec unshare --user --mount "$@"
