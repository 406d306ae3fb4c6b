/* Copyright 2026 The accel_calib authors
 * SPDX-License-Identifier: Apache-2.0
 *
 * A library for LD_PRELOAD that counts the changes of files below a folder, and lets one of them
 * fail: the process is killed before it or in the middle of a write, or the call returns an error.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <signal.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/sendfile.h>
#include <sys/stat.h>
#include <sys/types.h>
#include <unistd.h>

enum { COUNT, KILL, TORN, FAIL };

static char *folder;
static int kind = COUNT, error_code, at = -1, count;

/* Start to count below a folder. The change number `where`, from 0, fails as `how` says. */
void fault_arm(const char *below, int where, int how, int code)
{
    free(folder);
    folder = below ? strdup(below) : NULL;
    at = where;
    kind = how;
    error_code = code;
    count = 0;
}

int fault_count(void) { return count; }

static int inside(const char *path)
{
    return folder && path && strncmp(path, folder, strlen(folder)) == 0;
}

static int inside_file(int file)
{
    char link[64], path[4096];
    ssize_t length;
    if (!folder)
        return 0;
    snprintf(link, sizeof link, "/proc/self/fd/%d", file);
    length = readlink(link, path, sizeof path - 1);
    if (length < 0)
        return 0;
    path[length] = 0;
    return inside(path);
}

/* Return whether this change fails; errno is then set. */
static int fails(void)
{
    if (count++ != at)
        return 0;
    if (kind == KILL || kind == TORN)
        kill(getpid(), SIGKILL);
    errno = error_code;
    return kind == FAIL;
}

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))

#define OPEN(name)                                                        \
    int name(const char *path, int flags, ...)                            \
    {                                                                     \
        va_list rest;                                                     \
        mode_t mode;                                                      \
        va_start(rest, flags);                                            \
        mode = va_arg(rest, mode_t);                                      \
        va_end(rest);                                                     \
        if ((flags & (O_CREAT | O_WRONLY | O_RDWR)) && inside(path) && fails()) \
            return -1;                                                    \
        return REAL(name)(path, flags, mode);                             \
    }

OPEN(open)
OPEN(open64)

ssize_t write(int file, const void *data, size_t size)
{
    if (inside_file(file)) {
        if (kind == TORN && count == at)
            REAL(write)(file, data, size / 2);
        if (fails())
            return -1;
    }
    return REAL(write)(file, data, size);
}

#define OF_FILE(type, name, arguments, values)                            \
    type name arguments                                                   \
    {                                                                     \
        if (inside_file(file) && fails())                                 \
            return -1;                                                    \
        return REAL(name) values;                                         \
    }

#define OF_PATH(name, arguments, values)                                  \
    int name arguments                                                    \
    {                                                                     \
        if (inside(path) && fails())                                      \
            return -1;                                                    \
        return REAL(name) values;                                         \
    }

OF_FILE(int, fsync, (int file), (file))
OF_FILE(int, fchmod, (int file, mode_t mode), (file, mode))
OF_FILE(int, fchown, (int file, uid_t user, gid_t group), (file, user, group))
OF_FILE(int, ftruncate, (int file, off_t size), (file, size))
OF_FILE(int, ftruncate64, (int file, off64_t size), (file, size))
OF_FILE(ssize_t, sendfile, (int file, int from, off_t *at, size_t size), (file, from, at, size))
OF_FILE(ssize_t, sendfile64, (int file, int from, off64_t *at, size_t size),
        (file, from, at, size))
OF_PATH(rename, (const char *path, const char *target), (path, target))
OF_PATH(unlink, (const char *path), (path))
OF_PATH(mkdir, (const char *path, mode_t mode), (path, mode))
