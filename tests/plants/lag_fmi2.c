/* y' = r~ - y as an FMU for co-simulation, after the FMI 2.0 specification, with the faults that others were seen to have:
 * ONCE: there can be one instance in a process. RESET: fmi2Reset fails (1), or does nothing (2). STEP: the only step that
 * is taken. STOP: a step that goes beyond this time fails. END: a step that goes beyond this time ends the simulation.
 * CRASH: a step beyond this time ends the process. */

#include <math.h>
#include <stdlib.h>
#include <string.h>

enum { OK = 0, DISCARD = 2, ERROR = 3, VARIABLES = 2 };
enum { R_TILDE, Y };

typedef void (*Logger)(void *, const char *, int, const char *, const char *, ...);

typedef struct {
    Logger logger;
    void *(*allocate)(size_t, size_t);
    void (*free)(void *);
    void *finished, *environment;
} Callbacks;

typedef struct {
    const Callbacks *callbacks;
    double value[VARIABLES], time;
    int initialized, ended;
} Lag;

static int instances;

#define REFUSED(name) int fmi2##name(void) { return ERROR; }

REFUSED(SetDebugLogging) REFUSED(Terminate) REFUSED(GetInteger) REFUSED(GetBoolean) REFUSED(GetString)
REFUSED(SetInteger) REFUSED(SetBoolean) REFUSED(SetString) REFUSED(GetFMUstate) REFUSED(SetFMUstate)
REFUSED(FreeFMUstate) REFUSED(SerializedFMUstateSize) REFUSED(SerializeFMUstate) REFUSED(DeSerializeFMUstate)
REFUSED(GetDirectionalDerivative) REFUSED(SetRealInputDerivatives) REFUSED(GetRealOutputDerivatives)
REFUSED(CancelStep) REFUSED(GetStatus) REFUSED(GetRealStatus) REFUSED(GetIntegerStatus) REFUSED(GetStringStatus)

const char *fmi2GetTypesPlatform(void) { return "default"; }
const char *fmi2GetVersion(void) { return "2.0"; }

static int said(const Lag *lag, int status, const char *text)
{
    lag->callbacks->logger(lag->callbacks->environment, "lag", status, "error", text);
    return status;
}

void *fmi2Instantiate(const char *name, int kind, const char *guid, const char *resources, const Callbacks *callbacks,
                      int visible, int logging)
{
    Lag *lag;

    (void)name, (void)kind, (void)resources, (void)visible, (void)logging;
    if (strcmp(guid, "lag") != 0)
        return NULL;
#ifdef ONCE
    if (instances > 0)
        return NULL;
#endif
    instances++;
    lag = calloc(1, sizeof *lag);
    lag->callbacks = callbacks;
    return lag;
}

void fmi2FreeInstance(Lag *lag)
{
#if ONCE != 2 /* 2: not even one after the other */
    instances--;
#endif
    free(lag);
}

int fmi2Reset(Lag *lag)
{
#if RESET == 1
    return said(lag, ERROR, "no licence to reset");
#else
#if RESET != 2
    lag->value[R_TILDE] = lag->value[Y] = 0.0;
#endif
    lag->time = 0.0;
    lag->initialized = lag->ended = 0;
    return OK;
#endif
}

int fmi2SetupExperiment(Lag *lag, int with_tolerance, double tolerance, double start, int with_stop, double stop)
{
    (void)with_tolerance, (void)tolerance, (void)with_stop, (void)stop;
    lag->time = start;
    return OK;
}

int fmi2EnterInitializationMode(Lag *lag) { return lag->initialized ? ERROR : OK; }

int fmi2ExitInitializationMode(Lag *lag)
{
    lag->initialized = 1;
    return OK;
}

int fmi2GetReal(const Lag *lag, const unsigned vr[], size_t n, double value[])
{
    for (size_t i = 0; i < n; i++)
        value[i] = lag->value[vr[i]];
    return OK;
}

int fmi2SetReal(Lag *lag, const unsigned vr[], size_t n, const double value[])
{
    for (size_t i = 0; i < n; i++)
        lag->value[vr[i]] = value[i];
    return OK;
}

int fmi2GetBooleanStatus(const Lag *lag, int kind, int *value)
{
    *value = kind == 3 && lag->ended;
    return OK;
}

int fmi2DoStep(Lag *lag, double time, double step, int no_set_before)
{
    (void)no_set_before;
    if (!lag->initialized || fabs(time - lag->time) > 1e-9)
        return said(lag, ERROR, "the time is another");
#ifdef STEP
    if (fabs(step - STEP) > 1e-9)
        return said(lag, DISCARD, "the step is another");
#endif
#ifdef STOP
    if (time + step > STOP + 1e-9)
        return said(lag, ERROR, "beyond the stop time");
#endif
#ifdef END
    if (time + step > END + 1e-9) {
        lag->ended = 1;
        return DISCARD;
    }
#endif
#ifdef CRASH
    if (time + step > CRASH + 1e-9)
        abort();
#endif
    lag->value[Y] = lag->value[R_TILDE] + (lag->value[Y] - lag->value[R_TILDE]) * exp(-step);
    lag->time = time + step;
    return OK;
}
